"""Measures the tradeoff of a scene: quality against frame time, number of Gaussians and bytes."""
