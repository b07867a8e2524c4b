"""Lens distortion: maps pixels of a pinhole image to the distorted photo.

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
    """Whether pixel distances are proportional to angles rather than to their tangents."""
    params: tuple[float, ...]
    """k1 to k4 for a fisheye; otherwise k1, k2, p1, p2, k3, k4, k5, k6."""


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
"""COLMAP models whose parameters are a prefix of OpenCV's, and whether they are fisheyes."""


def lens_of(model: str, distortion: tuple[float, ...]) -> Lens | None:
    """The lens of a COLMAP camera model with distortion parameters; None for a pinhole. Raises
    ValueError, with the reason, if undistortion is not supported."""
    if model not in _MODELS:
        raise ValueError(f"distortion of the model {model}; expected one of {', '.join(_MODELS)}")
    if not all(math.isfinite(number) for number in distortion):
        raise ValueError("distortion that is not finite")
    fisheye = _MODELS[model]
    if not fisheye and not any(distortion):
        return None
    return Lens(fisheye, (*distortion, *[0.0] * ((4 if fisheye else 8) - len(distortion))))


def distorted(lens: Lens, points: Tensor) -> Tensor:
    """Undistorted points (..., 2) in the plane at depth 1, moved to their distorted positions."""
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
    """Radial distortion factor for radii ``r`` at depth 1."""
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
    """Map pixels of a pinhole image to a photo of the same intrinsics and size.

    A distortion polynomial turns back outside of the image range that it was fitted to; larger
    radii are invalid.

    Args:
        lens: of the photo.
        K: (3, 3) intrinsics, pixels; the centre of the first pixel is (0.5, 0.5).
        width, height: pixels.

    Returns:
        (H, W, 2) float32, x and y in the photo, with its sides at -1 and 1; and whether the photo
        contains the pixel, (H, W) bool.
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
