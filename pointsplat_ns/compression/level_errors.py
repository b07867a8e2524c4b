"""The errors of a level of detail: of its renders, as seen from where they were made and from farther away, and of the
places of its Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.compression.closeness import Closeness, DenseReference
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import render, render_depth
from pointsplat_ns.views import Views

FARTHER = (2, 4, 8)
"""How many times as far away errors are also measured."""

_DEPTH_SIDE = 100
"""Longer side, in pixels, of the depth images that the distance of the compared views is taken from."""

_CHUNK = 1 << 20
"""Gaussians at a time whose distances are computed in float64."""


@dataclass(frozen=True, eq=False)
class FarReference:
    """What should be seen from so many times as far as the compared views: a scene there covers as many times fewer
    pixels a side, and each shows the mean of a square of those of the near image."""

    times: int
    views: Views
    """The compared views with so many times fewer pixels a side."""
    targets: list[Tensor]
    """The dense scene's near renders, averaged over squares of pixels."""

    @torch.no_grad()
    def psnr(self, scene: Gaussians) -> float:
        """PSNR of a scene's renders over all pixels of all views, dB.

        The dense scene itself does not reach inf: Gaussians smaller than a pixel are drawn as large as one, so its
        renders from afar are coarser than what should be seen, and those of a level can be closer to that.
        """
        pairs = zip(self.views, self.targets, strict=True)
        errors = [float((render(scene, view).double() - target).square().mean()) for view, target in pairs]
        return Closeness(tuple(errors), None).psnr


@dataclass(frozen=True)
class RenderErrors:
    """Errors of a level's renders against the dense scene's own."""

    near: Closeness
    """In the compared views."""
    farther: dict[int, float]
    """PSNR, dB, by how many times as far the level is seen from: see :class:`FarReference`."""

    def view_psnr(self, index: int) -> float:
        """PSNR of one compared view, dB."""
        return Closeness((self.near.errors[index],), None).psnr


@dataclass(frozen=True)
class Displacement:
    """How far the centres of the dense scene's Gaussians are from those of the level's that they were merged into,
    scene units. Gaussians that were dropped do not count."""

    rms: float
    median: float
    p95: float
    """The 95th percentile."""


def far_references(reference: DenseReference) -> list[FarReference]:
    """What should be seen from each of :data:`FARTHER` for which the compared views have enough pixels."""
    views = reference.views
    found = []
    for times in FARTHER:
        if times > min(views.width, views.height):
            continue
        shrink = views.Ks.new_tensor([[1 / times], [1 / times], [1.0]])
        smaller = replace(views, Ks=views.Ks * shrink, width=views.width // times, height=views.height // times)
        targets = [_averaged(image, times) for image in reference.renders]
        found.append(FarReference(times, smaller, targets))
    return found


def _averaged(image: Tensor, side: int) -> Tensor:
    """Means (H // side, W // side, 3), float64, of squares of ``side`` pixels of an image (H, W, 3)."""
    return torch.nn.functional.avg_pool2d(image.double().permute(2, 0, 1), side).permute(1, 2, 0)


@torch.no_grad()
def displacement(dense: Gaussians, level: Gaussians, assignment: Tensor) -> Displacement:
    """How far merging moved the centres of Gaussians.

    Args:
        dense: N Gaussians.
        level: K Gaussians that they were merged into.
        assignment: (N,) index in ``level`` of the Gaussian that each is in; -1 if dropped. At least one is not.
    """
    own = (assignment >= 0).nonzero()[:, 0]
    distances = torch.cat(
        [(dense.means[i].double() - level.means[assignment[i]].double()).norm(dim=1) for i in own.split(_CHUNK)]
    )
    median, p95 = np.quantile(distances.cpu().numpy(), (0.5, 0.95))
    return Displacement(math.sqrt(float(distances.square().mean())), float(median), float(p95))


@torch.no_grad()
def distance_seen(dense: Gaussians, reference: DenseReference) -> float | None:
    """The median depth of what the compared views show, scene units; None if they show nothing."""
    depths = []
    for view in replace(reference.views, rasterize_mode="classic").resized(_DEPTH_SIDE):
        depth, alpha = render_depth(dense, view)
        depths.append(depth[alpha > 0.5].double().cpu())
    seen = torch.cat(depths)
    return float(seen.median()) if len(seen) else None
