"""Finds the distance at which a level of detail suffices, from renders in near and far views."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.nn.functional import avg_pool2d

from pointsplat_ns.rendering import render_depth
from pointsplat_ns.rendering.comparison.closeness import Reference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.tensors import DOUBLES

ENOUGH = 30.0
"""PSNR against the dense scene at which a level suffices, dB; see :func:`pixel_size_for`."""


def pixel_sizes(
    dense: Gaussians, reference: Reference, levels: Sequence[Gaussians], near: Sequence[float]
) -> list[float] | None:
    """Scene units per pixel at which each level suffices; None if the dense scene covers no pixel.

    Args:
        dense: the scene of the levels.
        reference: renders of the dense scene.
        levels: scenes of the levels.
        near: PSNR of each level in the views of the judge, dB.
    """
    distance = median_depth(dense, reference)
    if distance is None:
        return None
    pixel = distance / float(reference.views.Ks[:, 1, 1].median())
    afar = far_references(reference)
    whole, *others = (
        {times: far.psnr(scene)[0] for times, far in afar.items()} for scene in (dense, *levels)
    )
    return [
        pixel_size_for({1: psnr, **psnrs}, whole, pixel)
        for psnr, psnrs in zip(near, others, strict=True)
    ]


def pixel_size_for(psnrs: dict[int, float], whole: dict[int, float], pixel_size: float) -> float:
    """Scene units per pixel at which a level suffices: its PSNR reaches :data:`ENOUGH`, or the PSNR
    of the dense scene if that is lower.

    There, a line through the measured differences over the logarithm of the distance crosses zero.
    The result is between an eighth of the compared distance and 64 times it.

    Args:
        psnrs: PSNR of the level by multiple of the distance, dB.
        whole: the same of the dense scene.
        pixel_size: pixel size of the compared views at the median depth, scene units.
    """
    short = [
        min(psnr, 99.0) - min(ENOUGH, whole.get(times, ENOUGH)) for times, psnr in psnrs.items()
    ]
    doublings = torch.tensor([*psnrs], **DOUBLES).log2()
    gap = torch.tensor(short, **DOUBLES)
    about = doublings - doublings.mean()
    # dB per doubling of the distance
    slope = max(float((about @ gap) / about.square().sum().clamp_min(1e-9)), 1.0)
    return pixel_size * 2.0 ** min(max(float(doublings.mean() - gap.mean() / slope), -3.0), 6.0)


def far_references(reference: Reference) -> dict[int, Reference]:
    """Target images at multiples of the distance (2, 4, 8), while the compared views have enough
    pixels.

    From farther away, the scene covers a smaller part of the picture. A target is therefore a near
    render, averaged over squares of ``times`` x ``times`` pixels. Even the dense scene has a finite
    PSNR: the rasterizer draws no Gaussian thinner than a pixel, so its distant renders are coarser
    than the targets. A level can be closer to the targets than the dense scene.
    """
    views = reference.views
    references = {}
    for times in (2, 4, 8):
        if times > min(min(size[:2]) for size in views.image_sizes()):
            continue
        smaller = views.each_size(functools.partial(_reduced, times=times))
        targets = [
            avg_pool2d(image.double().permute(2, 0, 1), times).permute(1, 2, 0)
            for image in reference.renders
        ]
        references[times] = Reference(smaller, targets, reference.covered)
    return references


def _reduced(views: Views, times: int) -> Views:
    """Views of one size whose pixels are squares of ``times`` x ``times`` pixels."""
    shrink = views.Ks.new_tensor([[1 / times], [1 / times], [1.0]])
    size = views.width // times, views.height // times
    return replace(views, Ks=views.Ks * shrink, width=size[0], height=size[1])


@torch.no_grad()
def median_depth(dense: Gaussians, reference: Reference) -> float | None:
    """Median depth over the covered pixels of the compared views, scene units; None if there is
    none."""
    depths = []
    for view in replace(reference.views, rasterize_mode="classic").resized(100):
        depth, alpha = render_depth(dense, view)
        depths.append(depth[alpha > 0.5].double().cpu())
    covered = torch.cat(depths)
    return float(covered.median()) if len(covered) else None
