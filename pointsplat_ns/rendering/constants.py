"""Thresholds of 3D Gaussian rasterization, with the values of 3DGS and gsplat."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian with a lower alpha is not drawn on a pixel, because it cannot change an 8-bit
image."""

ALPHA_MAX = 0.999
"""Upper bound of alpha, so that 1 - alpha never vanishes and the backward pass can divide by it."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished before the Gaussian that would bring its transmittance to this or less."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is evaluated at most this share of half the image size outside of the image, as in
3DGS."""

COMPENSATION_MIN = 0.005
"""Lower bound of the antialiasing compensation factor."""

TILE = 8
"""Tile side, pixels. 8 was faster than 16 in measurements: fewer pixels are evaluated in vain."""

SLACK = 1e-3
"""Margin around each ellipse, pixels, so that rounding never drops a drawn pixel."""

QUALITIES = {"exact": ALPHA_MIN, "balanced": 2 / 255, "fast": 8 / 255}
"""Lowest drawn alpha by name of the quality, measured by lab/speed/rasterizer.py. A higher stop
threshold would skip the opaque Gaussian that finishes a pixel, an error of up to 0.5."""

MEMORY_BUDGET = 2**31
"""Bytes of the lists of pairs of one image, above which it is drawn in several regions."""
