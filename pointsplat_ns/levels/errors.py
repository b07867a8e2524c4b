"""Errors of a level of detail: of its renders in near and farther views, and of the positions of its Gaussians."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import Closeness, Reference
from pointsplat_ns.rasterizer import render_depth


@dataclass(frozen=True)
class RenderErrors:
    """Errors of a level's renders against the dense scene's own."""

    near: Closeness
    """In the compared views."""
    farther: dict[int, float]
    """PSNR in dB by multiple of the distance, see :func:`far_references`."""


@dataclass(frozen=True)
class Displacement:
    """Distances from the centres of the dense scene's Gaussians to the centres of the Gaussians that contain them in
    the level, scene units. Dropped Gaussians do not count."""

    rms: float
    median: float
    p95: float
    """The 95th percentile."""


def far_references(reference: Reference) -> dict[int, Reference]:
    """Target images at each multiple of the distance (2, 4, 8), as far as the compared views have enough
    pixels.

    The scene covers a smaller part of the picture there, so a target is a near render with each square of ``times`` x
    ``times`` pixels averaged. The dense scene itself does not reach inf: the rasterizer draws Gaussians no thinner than
    a pixel, so its distant renders are coarser than the targets. A level can be closer to the targets than the dense
    scene.
    """
    views, found = reference.views, {}
    for times in (2, 4, 8):
        if times > min(views.width, views.height):
            continue
        shrink = views.Ks.new_tensor([[1 / times], [1 / times], [1.0]])
        smaller = replace(views, Ks=views.Ks * shrink, width=views.width // times, height=views.height // times)
        targets = [_averaged(image, times) for image in reference.renders]
        found[times] = Reference(smaller, targets, reference.covered)
    return found


def _averaged(image: Tensor, side: int) -> Tensor:
    """Means (H // side, W // side, 3), float64, of squares of ``side`` pixels of an image (H, W, 3)."""
    return torch.nn.functional.avg_pool2d(image.double().permute(2, 0, 1), side).permute(1, 2, 0)


@torch.no_grad()
def displacement(dense: Gaussians, level: Gaussians, assignment: Tensor) -> Displacement:
    """Measure how far merging moved the centres of Gaussians, by the index (N,) in ``level`` of each Gaussian of
    ``dense``; -1 if dropped. At least one is not dropped."""
    own = (assignment >= 0).nonzero()[:, 0]
    pieces = own.split(1 << 20)  # because float64 takes memory
    distances = torch.cat([(dense.means[i].double() - level.means[assignment[i]].double()).norm(dim=1) for i in pieces])
    median, p95 = np.quantile(distances.cpu().numpy(), (0.5, 0.95))
    return Displacement(math.sqrt(float(distances.square().mean())), float(median), float(p95))


@torch.no_grad()
def median_depth(dense: Gaussians, reference: Reference) -> float | None:
    """The median depth over the covered pixels of the compared views, scene units; None if no pixel is covered."""
    depths = []
    for view in replace(reference.views, rasterize_mode="classic").resized(100):
        depth, alpha = render_depth(dense, view)
        depths.append(depth[alpha > 0.5].double().cpu())
    covered = torch.cat(depths)
    return float(covered.median()) if len(covered) else None
