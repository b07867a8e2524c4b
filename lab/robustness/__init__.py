"""Faults: hostile files, killed commands, faults put into the code, and long runs."""
