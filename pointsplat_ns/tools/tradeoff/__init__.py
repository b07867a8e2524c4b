"""Measures the tradeoff of a scene: quality against frame time, count and size."""
