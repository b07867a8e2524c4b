"""The errors of a level of detail: of its renders, as seen from where they were made and from farther away, and of the
places of its Gaussians."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.compression.closeness import Closeness, DenseReference
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.metrics import SSIM_WINDOW, ssim
from pointsplat_ns.rasterizer import rasterization, render

FARTHER = (2, 4, 8, 16)
"""How many times as far away errors are also measured."""

_DEPTH_SIDE = 100
"""Longer side, in pixels, of the depth images that the distance of the compared views is taken from."""

_CHUNK = 1 << 20
"""Gaussians at a time whose distances are computed in float64."""


@dataclass(frozen=True)
class RenderErrors:
    """Errors of a level's renders against the dense scene's own."""

    near: Closeness
    """In the compared views."""
    farther: dict[int, float]
    """PSNR in dB, over all pixels of all views, as seen from so many times as far (:data:`FARTHER`): of images averaged
    over squares of so many pixels a side. Views too small for a square lack it."""

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


@torch.no_grad()
def render_errors(
    reference: DenseReference, level: Gaussians, progress: Callable[[float], None] | None = None
) -> RenderErrors:
    """Errors of a level's renders, from near and from afar.

    Args:
        reference: renders of the dense scene.
        level: the scene to compare.
        progress: called with the share of the views done.
    """
    views = reference.views
    squares = [side for side in FARTHER if side <= min(views.width, views.height)]
    errors: list[float] = []
    similarities: list[float] = []
    averaged: dict[int, list[float]] = {side: [] for side in squares}
    for index, target in enumerate(reference.renders):
        image = render(level, views[index])
        difference = (image.double() - target.double()).permute(2, 0, 1)
        errors.append(float(difference.square().mean()))
        for side in squares:
            averaged[side].append(float(torch.nn.functional.avg_pool2d(difference, side).square().mean()))
        if min(views.width, views.height) >= SSIM_WINDOW:
            similarities.append(float(ssim(image, target)))
        if progress is not None:
            progress((index + 1) / len(views))
    near = Closeness(tuple(errors), sum(similarities) / len(similarities) if similarities else None)
    return RenderErrors(near, {side: Closeness(tuple(values), None).psnr for side, values in averaged.items()})


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
    views = reference.views.resized(_DEPTH_SIDE)
    depths = []
    for index in range(len(views)):
        one = views[[index]]
        image, alpha, _ = rasterization(
            dense.means,
            dense.quats,
            dense.stds,
            dense.alphas,
            dense.means,  # any colours: only depths are rendered
            one.viewmats.to(dense.means),
            one.Ks.to(dense.means),
            one.width,
            one.height,
            render_mode="ED",
        )
        depths.append(image[0, ..., 0][alpha[0, ..., 0] > 0.5].double().cpu())
    seen = torch.cat(depths)
    return float(seen.median()) if len(seen) else None
