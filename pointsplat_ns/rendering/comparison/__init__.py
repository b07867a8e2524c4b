"""Renders of scenes beside those of the dense scene."""
