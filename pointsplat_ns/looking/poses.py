"""Cameras at given places, as sampled views are made of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.views import Views

FIELD_OF_VIEW = 70.0
"""Field of view across the longer side of the image, degrees: that of a phone's main camera."""

BACKGROUND = (0.0, 0.0, 0.0)

NEAR_PLANE = 1e-3
"""Depth that sampled views start at, as a share of the diagonal of the content's box."""


def look_at(positions: Tensor, targets: Tensor, up: Tensor | None = None) -> Tensor:
    """World-to-camera matrices (C, 4, 4) of cameras at ``positions`` (C, 3) that look at ``targets`` (C, 3), with
    ``up`` (3,), by default z, up where that is possible; OpenCV axes."""
    forward = targets - positions
    length = forward.norm(dim=1, keepdim=True)
    ahead = forward.new_tensor([1.0, 0.0, 0.0]).expand_as(forward)
    forward = torch.where(length > 0, forward / length.clamp_min(1e-300), ahead)
    up = forward.new_tensor([0.0, 0.0, 1.0]) if up is None else up.to(forward) / up.to(forward).norm()
    other = torch.eye(3, dtype=forward.dtype)[int(up.abs().argmin())]
    steep = (forward @ up).abs() > 0.99
    right = torch.linalg.cross(forward, torch.where(steep[:, None], other, up))
    right = right / right.norm(dim=1, keepdim=True)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=1)  # (C, 3, 3) world to camera
    viewmats = torch.eye(4, dtype=positions.dtype).repeat(len(positions), 1, 1)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -(rotation @ positions[..., None])[..., 0]
    return viewmats


def views_of(viewmats: Tensor, width: int, height: int, near_plane: float) -> Views:
    """Views (C) over black of :data:`FIELD_OF_VIEW`, from world-to-camera matrices (C, 4, 4)."""
    focal = 0.5 * max(width, height) / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=viewmats.dtype)
    Ks = K.repeat(len(viewmats), 1, 1)
    return Views(viewmats, Ks, width, height, torch.tensor(BACKGROUND), near_plane=near_plane)
