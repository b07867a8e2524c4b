"""How much of what could be in pictures is in them: what stands in front hides the rest."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.traces import means_around
from pointsplat_ns.rasterizer.pixel_walk import PixelBlock, sum_over_pixels
from pointsplat_ns.rasterizer.projection import project_scene
from pointsplat_ns.views import Views

LOOKED_AT = 16
"""Number of views, at most, that are walked through."""

SIDE = 160
"""Their longer side, pixels: it is counted who hides whom, which small pictures tell as well."""

NEIGHBOURHOOD = 17
"""Number of Gaussians along the curve that are counted together: of two in the same place, the one in front hides the
other, and either may be."""

WHOLE = 0.9
"""Quantile of the shares that counts as not hidden at all, as pixels are not in the unit of areas."""

LEAST = 1e-4
"""Least share, before the root is taken: what no view shows is not worth nothing, as others may be taken."""

POWER = 0.5
"""Exponent of the shares. Together with how much photos showed, which tells a part of the same: 1 gains 1.1 dB on one
capture at 10 % and loses up to 0.3 on another; 0.5 gains on all three that it was tried on."""


@torch.no_grad()
def pixels_of(scene: Gaussians, views: Views) -> Tensor:
    """Pixels that each Gaussian has in pictures: the sum over all of them of its alpha times the transmittance in
    front of it, by which its colour is weighted there.

    Args:
        scene: N Gaussians.
        views: any number of views.

    Returns:
        (N,) float64; 0 where no view shows it.
    """
    scene = scene.detach().to(torch.promote_types(scene.dtype, torch.float32))
    total = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)

    def weights(block: PixelBlock) -> Tensor:
        return torch.where(block.alpha > 0, block.alpha * block.before, 0.0).sum(-1, keepdim=True)

    for view in views:
        seen = project_scene(scene, view)
        total.index_add_(0, seen.ids, sum_over_pixels(seen, view.width, view.height, 1, weights)[:, 0].double())
    return total


def visibility(scene: Gaussians, members: Tensor, weights: Tensor, views: Views) -> Tensor:
    """Root of the share of the neighbourhood of each member that views really show, (n,) float32 in [1e-2, 1].

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) indices, n at least 1, in an order in which neighbours are near each other.
        weights: (n,) how large a unit of area at each member is in the views, if nothing stands before it.
        views: of the scene, in its own unit.
    """
    pixels = pixels_of(scene, views.spread(LOOKED_AT).resized(SIDE))[members]
    stds = scene.stds[members].double().sort(dim=1).values
    expected = weights.double() * scene.alphas[members].double() * stds[:, 1] * stds[:, 2]
    areas = means_around(expected.nan_to_num(0.0, 0.0, 0.0), NEIGHBOURHOOD)
    shares = means_around(pixels, NEIGHBOURHOOD) / areas.clamp_min(torch.finfo(torch.float64).tiny)
    whole = shares.sort().values[int(WHOLE * (len(shares) - 1))]
    if not 0 < float(whole) < math.inf:
        return torch.ones(len(members))
    return (shares / whole).clamp(LEAST, 1.0).pow(POWER).float()
