"""Cameras at given places, from which sampled views are made."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.views import Views


def look_at(positions: Tensor, targets: Tensor, up: Tensor | None = None) -> Tensor:
    """World-to-camera matrices of cameras that look at targets.

    Args:
        positions: (C, 3) of the cameras.
        targets: (C, 3); where a target is at its camera's position, the camera looks along x.
        up: (3,) direction that is up in the pictures, of any length; by default z. Cameras that look along it have
            another direction up.

    Returns:
        (C, 4, 4), OpenCV axes.
    """
    forward = targets - positions
    length = forward.norm(dim=1, keepdim=True)
    ahead = forward.new_tensor([1.0, 0.0, 0.0]).expand_as(forward)
    forward = torch.where(length > 0, forward / length.clamp_min(1e-300), ahead)
    up = forward.new_tensor([0.0, 0.0, 1.0]) if up is None else up.to(forward) / up.to(forward).norm()
    other = torch.eye(3, dtype=forward.dtype, device="cpu")[int(up.abs().argmin())]
    steep = (forward @ up).abs() > 0.99
    right = torch.linalg.cross(forward, torch.where(steep[:, None], other, up))
    right = right / right.norm(dim=1, keepdim=True)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=1)  # (C, 3, 3) world to camera
    viewmats = torch.eye(4, dtype=positions.dtype, device="cpu").repeat(len(positions), 1, 1)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -(rotation @ positions[..., None])[..., 0]
    return viewmats


def views_of(viewmats: Tensor, width: int, height: int, diagonal: float) -> Views:
    """Views over black from world-to-camera matrices.

    Args:
        viewmats: (C, 4, 4).
        width, height: size of the pictures, pixels.
        diagonal: of the content, in the unit of ``viewmats``; the near plane is a thousandth of it away.
    """
    focal = 0.5 * max(width, height) / math.tan(math.radians(LOOKING.field_of_view) / 2)
    K = torch.tensor(
        [[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=viewmats.dtype, device="cpu"
    )
    Ks = K.repeat(len(viewmats), 1, 1)
    return Views(viewmats, Ks, width, height, torch.zeros(3, **FLOATS), near_plane=1e-3 * diagonal)
