"""Errors of numbers: of float32 over decades."""
