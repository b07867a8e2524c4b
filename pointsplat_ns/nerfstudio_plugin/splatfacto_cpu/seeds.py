"""The points that a training of Splatfacto starts from."""

from __future__ import annotations

import torch
from nerfstudio.models.splatfacto import SplatfactoModelConfig
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.geometry.neighbours import nearest
from pointsplat_ns.system.tensors import FLOATS


def random_seeds(config: SplatfactoModelConfig) -> tuple[Tensor, Tensor]:
    """Positions (N, 3) in a cube around the origin, and no colours (0, 3), as Splatfacto starts without seed points."""
    return (torch.rand(config.num_random, 3, **FLOATS) - 0.5) * config.random_scale, torch.zeros(0, 3, **FLOATS)


def distance_to_others(points: Tensor, k: int) -> Tensor:
    """Mean distance (N, 1) from each point (N, 3) to its ``k`` nearest other positions, float32 and positive.

    Points at the same position count once, so that no distance is zero. With fewer than ``k`` other positions, the
    distance to the farthest is repeated; with none, the result is 0.01 scene units.
    """
    places, place_of = torch.unique(points, dim=0, return_inverse=True)
    if len(places) < 2:
        return torch.full((len(points), 1), 0.01, **FLOATS)
    distances = nearest(places, k + 1)[0][:, 1:]
    missing = distances[:, -1:].expand(-1, k - distances.shape[1])
    # Distinct positions can be so close that the distance is zero in float32.
    distances = torch.cat([distances, missing], dim=1).clamp(min=torch.finfo(torch.float32).tiny).float()
    return distances.mean(dim=1, keepdim=True)[place_of]


def finite_seeds(seeds: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor] | None:
    """Positions (N, 3) and colours (N, 3) as float32 without rows that are not finite; None if nothing is left.

    If all colours are black they are unknown, (0, 3), as in COLMAP models whose points were triangulated without
    photos. Renders clamp colours at black, where they have no gradient: the scene would stay black.
    """
    if seeds is None:
        return None
    points, colors = (value.detach().float().cpu() for value in seeds)
    finite = points.isfinite().all(dim=1)
    if len(colors) > 0:
        finite &= colors.isfinite().all(dim=1)
        colors = colors[finite]
    if not finite.all():
        CONSOLE.log(f"{int((~finite).sum())} of {len(points)} seed points are not finite and were dropped")
    if not finite.any():
        CONSOLE.log("no seed points are left; a training starts from random ones")
        return None
    if len(colors) > 0 and not colors.any():
        CONSOLE.log("all seed points are black, as where colours are unknown; a training starts from random colours")
        colors = colors[:0]
    return points[finite].clone(), colors.clone()
