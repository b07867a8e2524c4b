"""Lenses: where the pixels of a pinhole's picture lie in the photo that a lens took.

Source: the camera models of COLMAP and OpenCV, "Camera Calibration and 3D Reconstruction" and
"Fisheye camera model" in OpenCV's documentation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import DOUBLES, FLOATS


class Lens(NamedTuple):
    """The distortion of a lens."""

    fisheye: bool
    """Whether angles, and not their tangents, are proportional to pixels."""
    params: tuple[float, ...]
    """k1 to k4 of a fisheye; else k1, k2, p1, p2, k3, k4, k5, k6."""


_MODELS = {
    "SIMPLE_PINHOLE": False,
    "PINHOLE": False,
    "SIMPLE_RADIAL": False,
    "RADIAL": False,
    "OPENCV": False,
    "FULL_OPENCV": False,
    "SIMPLE_FISHEYE": True,
    "FISHEYE": True,
    "SIMPLE_RADIAL_FISHEYE": True,
    "RADIAL_FISHEYE": True,
    "OPENCV_FISHEYE": True,
}
"""Models of COLMAP whose parameters are the first ones of OpenCV's, and whether each is a
fisheye."""


def lens_of(model: str, distortion: tuple[float, ...]) -> Lens | None:
    """The lens of a camera model of COLMAP and its parameters of distortion; None if it is a
    pinhole. Raises ValueError, with the reason, if it is not known how to undo it."""
    if model not in _MODELS:
        raise ValueError(f"distortion of the model {model}; expected one of {', '.join(_MODELS)}")
    if not all(math.isfinite(number) for number in distortion):
        raise ValueError("distortion that is not finite")
    fisheye = _MODELS[model]
    if not fisheye and not any(distortion):
        return None
    return Lens(fisheye, (*distortion, *[0.0] * ((4 if fisheye else 8) - len(distortion))))


def distorted(lens: Lens, points: Tensor) -> Tensor:
    """Points (..., 2) of the plane at depth 1, where a pinhole sees them, moved to where the lens
    shows them."""
    r = points.norm(dim=-1, keepdim=True)
    if lens.fisheye:
        return points * _ratio(lens, r)
    p1, p2 = lens.params[2:4]
    twice_xy = 2 * points.prod(-1, keepdim=True)
    squares = r**2 + 2 * points**2
    return (
        points * _ratio(lens, r)
        + twice_xy * points.new_tensor([p1, p2])
        + squares * points.new_tensor([p2, p1])
    )


def _ratio(lens: Lens, r: Tensor) -> Tensor:
    """Factor on radii ``r`` at depth 1, without the tangential part."""
    if lens.fisheye:
        angle = r.atan()
        square = angle**2
        k1, k2, k3, k4 = lens.params
        bent = angle * (1 + square * (k1 + square * (k2 + square * (k3 + square * k4))))
        return torch.where(r > 1e-9, bent / r.clamp_min(1e-9), 1.0)
    k1, k2, _, _, k3, k4, k5, k6 = lens.params
    s = r**2
    return (1 + s * (k1 + s * (k2 + s * k3))) / (1 + s * (k4 + s * (k5 + s * k6)))


def pixel_map(lens: Lens, K: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Where the pixels of a pinhole's picture lie in a photo of the same intrinsics and size.

    A polynomial of distortion turns back beyond the pictures that it was fitted to: radii there are
    not taken.

    Args:
        lens: of the photo.
        K: (3, 3) intrinsics, pixels, the first pixel's centre at (0.5, 0.5).
        width, height: pixels.

    Returns:
        (H, W, 2) float32, x and y in the photo, its sides at -1 and 1; and whether the photo shows
        the pixel, (H, W) bool.
    """
    focal = K.new_tensor([K[0, 0], K[1, 1]])
    centre = K[:2, 2]
    size = K.new_tensor([width, height])
    across, down = (torch.arange(side, **DOUBLES) + 0.5 for side in (width, height))
    points = (torch.stack(torch.meshgrid(across, down, indexing="xy"), dim=-1) - centre) / focal
    radii = torch.linspace(0, float(points.norm(dim=-1).max()), 4096, **DOUBLES)
    falls = (radii * _ratio(lens, radii)).diff() <= 0
    limit = float(radii[int(falls.nonzero()[0])]) if bool(falls.any()) else math.inf
    places = 2 * (distorted(lens, points) * focal + centre) / size - 1
    shown = (points.norm(dim=-1) <= limit) & (places.abs() <= 1).all(-1)
    return places.nan_to_num(2.0).clamp(-2, 2).to(FLOATS["dtype"]), shown
