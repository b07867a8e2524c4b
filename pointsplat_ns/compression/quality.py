"""How good a smaller scene is at the size that people look at, measured in few pixels: bands of pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import DenseReference, views_text
from pointsplat_ns.pruning.merging.settings import DEFAULTS as MERGING
from pointsplat_ns.views import Views, spread_indices


@dataclass(frozen=True)
class QualitySettings:
    """The pixels that are compared. A tenth of a statue and of a bathroom of 58,000 Gaussians have 24.35 and 24.99 dB
    in these bands, 24.39 and 24.45 dB in 12 whole pictures, at a tenth of their CPU seconds; windows of as many pixels
    that are 320 wide are off by 1.1 dB (standard deviation)."""

    views: int = 8
    """Largest number of views."""
    bands: int = 4
    """Number of bands in each picture."""
    rows: int = 32
    """Height of a band, pixels."""


QUALITY = QualitySettings()


@dataclass(frozen=True)
class Quality:
    """How close a scene's renders are to the dense scene's."""

    psnr: float
    """PSNR over the pixels that the dense scene covers, dB; inf if nothing differs."""
    views: int
    """Number of views."""
    width: int
    """Width of their pictures, pixels."""
    height: int
    """Height of their pictures, pixels."""

    def __str__(self) -> str:
        where = f"({views_text(self.views)}, {self.width} x {self.height})"
        if self.psnr == math.inf:
            return f"no difference from the dense scene {where}"
        return f"{self.psnr:.1f} dB PSNR against the dense scene {where}"


def quality_of(dense: Gaussians, scene: Gaussians, views: Views) -> Quality:
    """Compare a scene with the dense scene in bands of pictures.

    Args:
        dense: N Gaussians.
        scene: K Gaussians.
        views: views of the dense scene at full size, from which it was merged, if it was. At most ``QUALITY.views`` are
            used, and none that the finish of merging compared, unless there are no others.
    """
    finish = spread_indices(len(views), MERGING.finish_views)
    if others := sorted({*range(len(views))} - {*finish}):
        views = views[torch.tensor(others)]
    views = views.spread(QUALITY.views)
    psnr, _ = DenseReference(dense, _bands(views)).psnr(scene)
    return Quality(psnr, len(views), views.width, views.height)


def _bands(views: Views) -> Views:
    """Bands of pictures at equal distances, as wide as these; the whole pictures if they have not more rows."""
    count, rows = QUALITY.bands, QUALITY.rows
    if views.height <= count * rows:
        return views
    step = (views.height - rows) / count
    repeated = views[torch.arange(len(views)).repeat_interleave(count)]
    Ks = repeated.Ks.clone()
    # The bands of each view stand elsewhere in their parts of the picture, so that together they see all heights.
    at = torch.arange(count).repeat(len(views)) + (torch.arange(len(Ks)) // count + 0.5) / len(views)
    Ks[:, 1, 2] -= (at * step).round().to(Ks)
    return replace(repeated, Ks=Ks, height=rows)
