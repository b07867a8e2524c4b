"""Cameras at given positions, the basis of sampled views."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.view_sampling.content import UNITS
from pointsplat_ns.view_sampling.settings import looking


def look_at(positions: Tensor, targets: Tensor, up: Tensor | None = None) -> Tensor:
    """World-to-camera matrices of cameras that look at targets.

    Args:
        positions: (C, 3) of the cameras.
        targets: (C, 3); if a target is at its camera's position, the camera looks along x.
        up: (3,) up direction of the images, of any length; by default z. Cameras that look along it
            get another up direction.

    Returns:
        (C, 4, 4), OpenCV axes.
    """
    forward = targets - positions
    length = forward.norm(dim=1, keepdim=True)
    ahead = forward.new_tensor([1.0, 0.0, 0.0]).expand_as(forward)
    forward = torch.where(length > 0, forward / length.clamp_min(1e-300), ahead)
    up = (
        forward.new_tensor([0.0, 0.0, 1.0])
        if up is None
        else up.to(forward) / up.to(forward).norm()
    )
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
    """Views with a black background from world-to-camera matrices.

    Args:
        viewmats: (C, 4, 4).
        width, height: size of the images, pixels.
        diagonal: of the content, in the unit of ``viewmats``; the near plane is at a thousandth of
            it.
    """
    focal = 0.5 * max(width, height) / math.tan(math.radians(looking().field_of_view) / 2)
    K = viewmats.new_tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    Ks = K.repeat(len(viewmats), 1, 1)
    return Views(viewmats, Ks, width, height, torch.zeros(3, **FLOATS), near_plane=1e-3 * diagonal)


def level_directions(up: Tensor, turn: Tensor) -> Tensor:
    """Directions (n, 3) perpendicular to ``up`` (3,), at angles (n,) around it, radians."""
    right = torch.linalg.cross(up, torch.eye(3, dtype=up.dtype, device="cpu")[up.abs().argmin()])
    right = right / right.norm()
    return turn.cos()[:, None] * right + turn.sin()[:, None] * torch.linalg.cross(up, right)


def whole_views(
    points: Tensor, up: Tensor, turns: Tensor, elevation: float, width: int, height: int
) -> Views:
    """Views around the content, each as near as possible with all of it in view; float64, units.

    Args:
        points: (M, 3) of the content, units.
        up: (3,) up direction, unit length.
        turns: (n,) azimuths of the cameras, radians.
        elevation: of the cameras above the content, degrees.
        width, height: size of the images, pixels.
    """
    # [3, 3] rows
    level = torch.stack([*level_directions(up, up.new_tensor([0.0, math.pi / 2])), up])
    quantiles = points.new_tensor([0.005, 0.995])  # points outside are not part of the subject
    middle = (points @ level.T).quantile(quantiles, dim=0).mean(0) @ level
    lift = math.radians(elevation)
    sides = math.cos(lift) * level_directions(up, turns.to(up)) + math.sin(lift) * up
    viewmats = look_at(sides, torch.zeros_like(sides), up)
    x, y, z = (viewmats[:, :3, :3] @ (points - middle).T).unbind(1)  # [n, M]
    reach = math.tan(math.radians(looking().field_of_view) / 2) / max(width, height)
    # maximum shares of the image's width and height that the subject fills
    across = 0.92
    along = 0.88
    needed = (
        torch.maximum(x.abs() / (across * width * reach), y.abs() / (along * height * reach)) - z
    )
    distances = needed.quantile(quantiles[1], dim=1).clamp_min(0.1)
    viewmats = look_at(middle + distances[:, None] * sides, middle.expand_as(sides), up)
    return views_of(viewmats, width, height, UNITS)


def around(count: int) -> Tensor:
    """Angles (count,) evenly spaced on a full circle, radians."""
    return torch.arange(count, **FLOATS) * (2 * math.pi / count)
