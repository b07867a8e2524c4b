"""Cameras around a scene that show all of it, and whether more is seen from above or from below.

All is in units of the content.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, in_units, thinned
from pointsplat_ns.looking.poses import look_at, views_of
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.upright import level_directions
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.system.tensors import FLOATS
from pointsplat_ns.views import Views


def whole_views(
    surface: Surface, up: Tensor, turns: Tensor, elevation: float, width: int = 960, height: int = 600
) -> Views:
    """Views from around the content, each as near as the whole of it allows.

    Args:
        surface: points of the scene.
        up: (3,) direction that is up, of length 1.
        turns: (n,) angles of the cameras around it, radians.
        elevation: of the cameras above the content, degrees; below 0 they look up at it.
        width: of the pictures, pixels.
        height: of the pictures, pixels.

    Returns:
        n views, float64, units.
    """
    points = surface.points
    level = torch.stack([*level_directions(up, up.new_tensor([0.0, math.pi / 2])), up])  # [3, 3] rows
    quantiles = points.new_tensor([0.005, 0.995])  # what lies beyond is no part of the subject
    middle = (points @ level.T).quantile(quantiles, dim=0).mean(0) @ level
    lift = math.radians(elevation)
    sides = math.cos(lift) * level_directions(up, turns.to(up)) + math.sin(lift) * up
    viewmats = look_at(sides, torch.zeros_like(sides), up)
    x, y, z = (viewmats[:, :3, :3] @ (points - middle).T).unbind(1)  # [n, M]
    reach = math.tan(math.radians(LOOKING.field_of_view) / 2) / max(width, height)
    across, along = 0.92, 0.88  # largest shares of the picture's width and height that the subject takes
    needed = torch.maximum(x.abs() / (across * width * reach), y.abs() / (along * height * reach)) - z
    distances = needed.quantile(quantiles[1], dim=1).clamp_min(0.1)
    viewmats = look_at(middle + distances[:, None] * sides, middle.expand_as(sides), up)
    return views_of(viewmats, width, height, UNITS)


def seen_from_above(scene: Gaussians, centre: Tensor, diagonal: float, surface: Surface, axis: Tensor) -> float:
    """Logarithm of the ratio of the Gaussians that are seen from above to those that are seen from below, if ``axis``
    (3,) points up; each from the best of some cameras around the content.

    Args:
        scene: N Gaussians on the CPU.
        centre: (3,) of its content.
        diagonal: of its content, scene units.
        surface: points of the scene.
        axis: (3,) of length 1.
    """
    few = in_units(thinned(scene, 20_000), centre, diagonal)

    def most(up: Tensor) -> int:
        views = whole_views(surface, up, around(6), 30.0).resized(128)
        return max(int((pixels_of(few, view) > 0.1).sum()) for view in views)

    return math.log((most(axis) + 1) / (most(-axis) + 1))


def around(count: int) -> Tensor:
    """Angles (count,) all around, radians."""
    return torch.arange(count, **FLOATS) * (2 * math.pi / count)
