"""What all cells have to know of the whole scene, from an evenly thinned one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.looking.content import content_size
from pointsplat_ns.looking.sampling import Sampler
from pointsplat_ns.merging.cells.partition import Cells
from pointsplat_ns.merging.participants import Participants, drawable
from pointsplat_ns.merging.rounds import views_and_weights
from pointsplat_ns.merging.settings import MergeSettings
from pointsplat_ns.merging.state import ColourAxes, principal_axes
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Overview:
    """What all cells have to know of the whole scene."""

    centre: Tensor  # [3] float64, of the content
    size: Tensor  # scalar float64, diagonal of the content, scene units
    keys: Tensor  # [m] int64, ascending places on the curve
    weights: Tensor  # [m] float32, visibility weights there
    middle: Tensor  # [3 (d+1)^2] of the axes of colours
    axes: Tensor  # [3 (d+1)^2, C]

    @property
    def colour_axes(self) -> ColourAxes:
        """Axes on which colours are compared."""
        return ColourAxes(self.middle, self.axes)

    def weights_at(self, keys: Tensor) -> Tensor:
        """Visibility weights (n,) at places (n,) on the curve."""
        return self.weights[torch.searchsorted(self.keys, keys).clamp_max_(len(self.keys) - 1)]


def overview_of(
    cells: Cells,
    views: Views | Sampler,
    settings: MergeSettings,
) -> Overview:
    """The overview of a scene; ``views`` as for :func:`~pointsplat_ns.merging.merge`."""
    share = cells.count / len(cells.sample)
    scene = cells.sample.replace(scales=cells.sample.scales + 0.5 * math.log(share))  # they cover as much as all
    members = drawable(scene, 1)
    participants = Participants(scene, members, *content_size(scene))
    _, weights = views_and_weights(participants, views, settings)
    axes = principal_axes(scene, members, settings)
    size = torch.tensor(participants.size, **DOUBLES)
    return Overview(participants.centre, size, cells.keys[members], weights, *axes)
