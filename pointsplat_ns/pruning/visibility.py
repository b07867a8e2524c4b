"""How much of what could be in pictures is in them: what stands in front hides the rest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.each_view import each_view
from pointsplat_ns.looking.traces import means_around
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.views import Views

LOOKED_AT = 48
"""Number of views, at most, that are looked at. Over 16, 48 gain 0.2 to 0.7 dB in a lounge, with its poses and without,
and -0.2 to 0.4 in eight other scenes, for a second or two."""

SIDE = 112
"""Their longer side, pixels: it is counted who hides whom, which small pictures tell as well."""

MOST_DRAWN = 500_000
"""Number of Gaussians, at most, that are drawn: of more, evenly chosen ones stand for all. In a lounge of 445,000 one
of two or four tells as much as all do (0.0 dB); in a bouquet of 117,000 one of four takes away 0.4 of the 1.4 dB that
are gained at 10 %."""

NEIGHBOURHOOD = 17
"""Number of Gaussians along the curve that are counted together: of two in the same place, the one in front hides the
other, and either may be."""

WHOLE = 0.9
"""Quantile of the shares that counts as not hidden at all, as pixels are not in the unit of areas."""

LEAST = 1e-4
"""Least share of a neighbourhood, before the root is taken: what no view shows is not worth nothing, as others may be
taken."""

LEAST_EACH = 0.16
"""Least share of a single Gaussian, before the root is taken: other views may show it. Of 0.25, 0.09 and 0.01, smaller
ones gain up to 0.3 dB on what is looked at from outside and on two captures, and lose as much in two built-in rooms."""

POWER = 0.5
"""Exponent of the shares. Together with how much photos showed, which tells a part of the same: 1 gains 1.1 dB on one
capture at 10 % and loses up to 0.3 on another; 0.5 gains on all three that it was tried on."""


@dataclass(frozen=True, eq=False)
class Shown:
    """What views show of some Gaussians, and what they would if nothing stood in front."""

    pixels: Tensor  # [n] float64
    expected: Tensor  # [n] float64, in a unit of its own

    @classmethod
    def of(cls, scene: Gaussians, members: Tensor, weights: Tensor, views: Views) -> Shown:
        """Look at a scene.

        Args:
            scene: N Gaussians on the CPU.
            members: (n,) indices, n at least 1, in an order in which neighbours are near each other.
            weights: (n,) how large a unit of area at each member is in the views, if nothing stands before it.
            views: of the scene, in its own unit.
        """
        pixels = torch.zeros(len(scene), dtype=torch.float64)
        small = views.spread(LOOKED_AT).resized(SIDE)
        for seen in each_view(list(small), len(scene), lambda view: pixels_of(scene, view)):
            pixels += seen
        stds = scene.stds[members].double().sort(dim=1).values
        expected = weights.double() * scene.alphas[members].double() * stds[:, 1] * stds[:, 2]
        return cls(pixels[members], expected.nan_to_num(0.0, 0.0, 0.0))

    def around(self) -> Tensor:
        """Root of the share of the neighbourhood of each that views really show, (n,) float32 in [1e-2, 1]."""
        return _roots(means_around(self.pixels, NEIGHBOURHOOD), means_around(self.expected, NEIGHBOURHOOD), LEAST)

    def each(self) -> Tensor:
        """Root of the share of each that views really show, (n,) float32 in [0.4, 1]."""
        return _roots(self.pixels, self.expected, LEAST_EACH)


def _roots(pixels: Tensor, expected: Tensor, least: float) -> Tensor:
    shares = pixels / expected.clamp_min(torch.finfo(torch.float64).tiny)
    whole = shares.sort().values[int(WHOLE * (len(shares) - 1))]
    if not 0 < float(whole) < math.inf:
        return torch.ones(len(shares))
    return (shares / whole).clamp(least, 1.0).pow(POWER).float()
