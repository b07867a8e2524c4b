"""The thresholds of 3D Gaussian rasterization, as the field uses them (3DGS, gsplat)."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian is not drawn on a pixel where its alpha is lower: it could not change an 8-bit
image."""

ALPHA_MAX = 0.999
"""Alpha is clamped here, so that 1 - alpha never vanishes and the backward pass can divide by
it."""

TRANSMITTANCE_MIN = 1e-4
"""A pixel is finished before the Gaussian that would bring its transmittance to this or less."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian is evaluated no farther outside the image than this share of half its extent, as in
3DGS."""

COMPENSATION_MIN = 0.005
"""Lower bound of the antialiasing compensation factor."""

TILE = 8
"""Tile edge in pixels. 8 was measured faster than 16: fewer pixels evaluated for nothing."""

SLACK = 1e-3
"""Pixels added around each ellipse, so that rounding never drops a pixel that is drawn."""

QUALITIES = {"exact": ALPHA_MIN, "balanced": 2 / 255, "fast": 8 / 255}
"""The lowest alpha that is drawn, by the name of a quality, measured by lab/speed/rasterizer.py. A
higher stop threshold would skip the opaque Gaussian that finishes a pixel, and be wrong by up to
0.5 there."""

MEMORY_BUDGET = 2**31
"""Bytes that the lists of pairs of one image may take before it is drawn in several regions."""
