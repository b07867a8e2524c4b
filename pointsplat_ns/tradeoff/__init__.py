"""The trade of a scene in hand, measured: quality against frame time, Gaussians and bytes."""
