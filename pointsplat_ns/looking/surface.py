"""Points on the surfaces of a scene, and which of them are seen from a place.

A depth image costs milliseconds; a few thousand points tell as much about what is visible, from a hundred places
at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.morton import curve_keys, unit_cells
from pointsplat_ns.geometry.quaternions import rotation_matrices
from pointsplat_ns.looking.content import UNITS, positions_in_units
from pointsplat_ns.looking.traces import how_much_seen, unit_sh

POINTS = 12288
"""Number of points that stand for a scene."""

_CLEAR = 0.1
"""Least opacity of the Gaussians that points are taken from, where there are any: a haze hides nothing."""

_ROWS, _COLUMNS = 40, 80
"""Cells that the directions around a place are sorted into, all of one solid angle (4 degrees wide at the equator)."""

_BEHIND = (0.05, 0.1)
"""How much farther than the nearest point of its cell a visible point may be: a share of the distance, and units."""

_NEIGHBOURS = 5
"""A place is as far from surfaces as from this many points: a few may float in the air."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Points drawn from the Gaussians of a scene, in units of its content.

    Gaussians are drawn by the square root of opacity times area: between their number, which says where photos show
    detail, and their area. A point lies within its Gaussian.
    """

    points: Tensor  # [M, 3] float64
    normals: Tensor  # [M, 3] float64 along the shortest axis of the Gaussian, of either sign
    flatness: Tensor  # [M] float64 in [0, 1]: 1 less the ratio of the shortest axis to the next
    widths: Tensor  # [M] float32, geometric mean of the two larger standard deviations of its Gaussian, units
    shown: Tensor  # [M] float32, how much photos showed of it, see :func:`~pointsplat_ns.looking.traces.how_much_seen`
    sh: Tensor  # [M, K, 3] float32, SH coefficients of its Gaussian, without the constant, at a length of 1

    @staticmethod
    def of(scene: Gaussians, centre: Tensor, size: float) -> Surface:
        """The points of a scene, the same ones each time.

        Args:
            scene: N Gaussians, at least one of them visible.
            centre: (3,) of its content.
            size: diagonal of its content, scene units.
        """
        generator = torch.Generator().manual_seed(0)
        alphas = scene.alphas.detach().double()
        log_areas = F.logsigmoid(scene.opacities[:, 0].double()) + scene.scales.double().topk(2).values.sum(1)
        weights = 0.5 * torch.where(scene.usable(), log_areas, -math.inf).nan_to_num(nan=-math.inf, posinf=math.inf)
        clear = alphas >= min(_CLEAR, float(alphas[weights > -math.inf].max()) if len(weights) else 0.0)
        weights = torch.where(clear, weights, -math.inf) if bool((weights[clear] > -math.inf).any()) else weights
        ranked = weights[weights > -math.inf].sort().values
        if len(ranked):  # giants are no more than the 99th percentile; all that has no area counts alike
            chances = (weights.clamp_max(ranked[int(0.99 * (len(ranked) - 1))]) - ranked[-1]).exp()
        else:
            chances = (scene.usable() & (alphas > 0)).double()
        cumulative = chances.cpu().cumsum(0)
        drawn = torch.rand(POINTS, generator=generator, dtype=torch.float64) * cumulative[-1]
        some = scene[torch.searchsorted(cumulative, drawn).clamp_max(len(scene) - 1).to(scene.device)].to("cpu")
        stds, order = (some.stds.double() * (UNITS / size)).sort(dim=1)
        axes = rotation_matrices(some.quats.double())  # columns are the axes
        axes = axes.gather(2, order[:, None, :].expand(-1, 3, 3))
        within = torch.randn(POINTS, 3, generator=generator, dtype=torch.float64).clamp(-1.5, 1.5) * stds
        points = positions_in_units(some.means, centre.cpu(), size) + (axes @ within[..., None])[..., 0]
        flatness = 1 - stds[:, 0] / stds[:, 1].clamp_min(1e-300)
        along = curve_keys(unit_cells(some.means)).argsort(stable=True)
        shown = torch.empty(POINTS)
        shown[along] = how_much_seen(some, along)
        widths = (stds[:, 1] * stds[:, 2]).sqrt().float()
        return Surface(points, axes[:, :, 0], flatness, widths, shown, unit_sh(some.features_rest))

    def clearance(self, places: Tensor) -> Tensor:
        """Distance (P,) from places (P, 3) to the nearest surface, units."""
        near = torch.cdist(places.float(), self.points.float(), compute_mode="donot_use_mm_for_euclid_dist")
        return near.topk(_NEIGHBOURS, dim=1, largest=False).values[:, -1]

    def seen_from(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Which points are visible from places.

        Args:
            places: (P, 3) positions, units.

        Returns:
            Whether each point is visible (P, M), and the share (P,) of all directions in which there is a surface.
        """
        offsets = self.points.float() - places.float()[:, None]  # [P, M, 3]
        far = offsets.norm(dim=2).clamp_min(1e-6)
        row = ((offsets[..., 2] / far + 1) * (_ROWS / 2)).long().clamp(0, _ROWS - 1)
        turn = torch.atan2(offsets[..., 1], offsets[..., 0]) * (_COLUMNS / (2 * math.pi))
        cell = row * _COLUMNS + turn.floor().long().remainder(_COLUMNS)
        nearest = torch.full((len(places), _ROWS * _COLUMNS), math.inf).scatter_reduce_(1, cell, far, "amin")
        share, units = _BEHIND
        seen = far <= nearest.gather(1, cell) * (1 + share) + units
        around = nearest.isfinite().view(-1, _ROWS // 2, 2, _COLUMNS // 2, 2).amax((2, 4))
        return seen, around.float().mean((1, 2))
