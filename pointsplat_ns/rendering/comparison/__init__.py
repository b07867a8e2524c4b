"""Compares renders of scenes with renders of the dense scene."""
