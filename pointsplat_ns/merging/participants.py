"""Which Gaussians of a scene are merged: those that can be drawn, in the order of a space-filling curve."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import curve_keys, unit_cells
from pointsplat_ns.looking.content import content_size, in_units, views_in_units
from pointsplat_ns.rasterizer.constants import ALPHA_MIN
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Participants:
    """The Gaussians that are merged, and the scene that they are part of."""

    scene: Gaussians  # N Gaussians on the CPU
    members: Tensor  # [n] int64, indices in the scene, along a space-filling curve: neighbours are near in memory
    centre: Tensor  # [3] float64, of the scene's content
    size: float
    """Diagonal of the scene's content, scene units."""

    @classmethod
    def of(cls, scene: Gaussians, members: Tensor) -> Participants:
        """The participants ``members`` (n,) of a scene on the CPU."""
        order = curve_keys(unit_cells(scene.means[members])).argsort(stable=True)
        return cls(scene, members[order], *content_size(scene))

    def __len__(self) -> int:
        return len(self.members)

    def in_units(self, scene: Gaussians) -> Gaussians:
        """A scene in the units of this scene's content, see :func:`~pointsplat_ns.looking.content.in_units`."""
        return in_units(scene, self.centre, self.size)

    def views_in_units(self, views: Views) -> Views:
        """Views of this scene in the same units."""
        return views_in_units(views, self.centre, self.size)


def drawable(scene: Gaussians, k: int) -> Tensor:
    """Ascending indices of the Gaussians that can be drawn; if they are fewer than ``k``, also of the most opaque ones
    that are too faint.

    Raises:
        BudgetError: if fewer than ``k`` have finite parameters.
    """
    usable = scene.usable()
    if int(usable.sum()) < k:
        raise BudgetError(f"cannot keep {k} Gaussians: {int(usable.sum())} of {len(scene)} have finite parameters")
    chosen = usable & (scene.alphas >= ALPHA_MIN)
    missing = k - int(chosen.sum())
    if missing > 0:
        faint = usable & ~chosen
        order = torch.where(faint, scene.opacities[:, 0], -math.inf).sort(descending=True, stable=True).indices
        chosen[order[faint[order]][:missing]] = True
    return chosen.nonzero()[:, 0]
