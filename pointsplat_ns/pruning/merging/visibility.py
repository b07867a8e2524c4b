"""Visibility: the share of each Gaussian's expected pixels that pictures really show. The rest is occluded.

A Gaussian of opacity a and area A at distance r is expected to cover ``a A / r^2`` pixels, up to a common factor. The
rasterizer tells how many it covers: the sum over pixels of its blend weight, alpha times transmittance. The ratio of
both, relative to that of Gaussians that nothing occludes, is the visibility share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.each_view import each_view
from pointsplat_ns.looking.traces import means_around
from pointsplat_ns.pruning.merging.settings import MergeSettings
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class PixelCounts:
    """Pixels of each Gaussian, over all views."""

    covered: Tensor  # [n] float64, pixels
    expected: Tensor  # [n] float64, as if nothing were occluded, up to a common factor

    def neighbourhood_shares(self, settings: MergeSettings) -> Tensor:
        """Visibility factor of the neighbourhood of each Gaussian along the curve, (n,) float32 in (0, 1]."""
        covered, expected = (
            means_around(pixels, settings.occlusion_neighbours) for pixels in (self.covered, self.expected)
        )
        return _visibility(covered, expected, settings.min_share_neighbours, settings)

    def single_shares(self, settings: MergeSettings) -> Tensor:
        """Visibility factor of each Gaussian by itself, (n,) float32 in (0, 1]."""
        return _visibility(self.covered, self.expected, settings.min_share_single, settings)


def count_pixels(
    scene: Gaussians, members: Tensor, weights: Tensor, views: Views, settings: MergeSettings
) -> PixelCounts:
    """Count the pixels of some Gaussians in small pictures.

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) indices, n at least 1, in an order in which neighbours are near each other.
        weights: (n,) pixels of a unit of area at each member, up to a common factor; see
            :mod:`~pointsplat_ns.pruning.merging.viewpoints`.
        views: of the scene, in its own unit.
        settings: ``occlusion_views`` and ``occlusion_side``.
    """
    covered = torch.zeros(len(scene), dtype=torch.float64)
    small = views.spread(settings.occlusion_views).resized(settings.occlusion_side)
    for pixels in each_view(list(small), len(scene), lambda view: pixels_of(scene, view)):
        covered += pixels
    stds = scene.stds[members].double().sort(dim=1).values
    expected = weights.double() * scene.alphas[members].double() * stds[:, 1] * stds[:, 2]
    return PixelCounts(covered[members], expected.nan_to_num(0.0, 0.0, 0.0))


def _visibility(covered: Tensor, expected: Tensor, minimum: float, settings: MergeSettings) -> Tensor:
    """Shares of expected pixels that are covered, relative to those not occluded, to the power of
    ``occlusion_exponent``; 1 for all if no view shows enough to tell."""
    shares = covered / expected.clamp_min(torch.finfo(torch.float64).tiny)
    unoccluded = shares.sort().values[int(settings.unoccluded_quantile * (len(shares) - 1))]
    if not 0 < float(unoccluded) < math.inf:
        return torch.ones(len(shares))
    return (shares / unoccluded).clamp(minimum, 1.0).pow(settings.occlusion_exponent).float()
