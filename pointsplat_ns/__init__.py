"""pointsplat_ns: small, good 3D Gaussian Splatting scenes, with or without a GPU."""

__version__ = "0.1.0"
