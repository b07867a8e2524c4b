"""How good a smaller scene is at the size that people look at, measured in few pixels of each picture."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from pointsplat_ns.compression.prune import Pruned
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import DenseReference, views_text
from pointsplat_ns.looking.fill import fill
from pointsplat_ns.looking.sizes import subsampled
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.merging.settings import MERGING
from pointsplat_ns.system.tensors import INDICES
from pointsplat_ns.views import Views, spread_indices


@dataclass(frozen=True)
class FullSizeQuality:
    """How close a scene's renders are to the dense scene's, and how much viewers have to draw."""

    psnr: float
    """PSNR over the pixels that the dense scene covers, dB; inf if nothing differs."""
    views: int
    """Number of views."""
    width: int
    """Width of their pictures, pixels."""
    height: int
    """Height of their pictures, pixels."""
    fill_before: float
    """Mean number of Gaussians of the dense scene that viewers draw on a pixel."""
    fill: float
    """The same of the scene."""

    def __str__(self) -> str:
        where = f"({views_text(self.views)}, {self.width} x {self.height})"
        close = "no difference from" if self.psnr == math.inf else f"{self.psnr:.1f} dB PSNR against"
        drawn = f"fill: {self.fill_before:.1f} -> {self.fill:.1f} Gaussians drawn per pixel"
        return f"{close} the dense scene {where}\n{drawn}"


def quality_of(dense: Gaussians, scene: Gaussians, views: Views) -> FullSizeQuality:
    """Compare a scene with the dense scene in subsampled pictures (:mod:`~pointsplat_ns.looking.sizes`). On a statue, a
    bathroom and flowers the PSNR is within 0.03 dB of that of the whole pictures.

    Of the views, which are at full size, at most ``VIEW_COUNTS.compared`` are used,
    and none that the finish of merging compared, unless there are no others.
    """
    finish = spread_indices(len(views), MERGING.finish_views)
    if others := sorted({*range(len(views))} - {*finish}):
        views = views[torch.tensor(others, **INDICES)]
    views = views.spread(VIEW_COUNTS.compared)
    psnr, _ = DenseReference(dense, subsampled(views, max(views.width, views.height))).psnr(scene)
    fills = fill(dense, views), fill(scene, views)
    return FullSizeQuality(psnr, len(views), views.width, views.height, *fills)


def quality_if_seen(dense: Gaussians, scene: Gaussians, views: Callable[[], Views]) -> FullSizeQuality | None:
    """:func:`quality_of` in some views; None if there is no place to look from."""
    try:
        return quality_of(dense, scene, views())
    except DataError:
        return None


def quality_of_pruned(dense: Gaussians, scene: Gaussians, pruned: Pruned, source: ViewSource) -> FullSizeQuality | None:
    """:func:`quality_of` in known views, else in those that merging rendered; None if there is no place to look
    from."""
    return quality_if_seen(dense, scene, lambda: source.known(VIEW_COUNTS.weighed) or pruned.views or source.whole())
