"""Errors of numbers: of float32 over decades, and of file formats."""
