"""Errors of a level of detail: of its renders in near and farther views."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pointsplat_ns.compression.quality import Quality
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import Reference
from pointsplat_ns.rasterizer import render_depth


@dataclass(frozen=True)
class RenderErrors:
    """Errors of a level's renders against the dense scene's own."""

    near: Quality
    """In the views that every command judges in."""
    farther: dict[int, float]
    """PSNR in dB by multiple of the distance, see :func:`far_references`."""


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
def median_depth(dense: Gaussians, reference: Reference) -> float | None:
    """The median depth over the covered pixels of the compared views, scene units; None if no pixel is covered."""
    depths = []
    for view in replace(reference.views, rasterize_mode="classic").resized(100):
        depth, alpha = render_depth(dense, view)
        depths.append(depth[alpha > 0.5].double().cpu())
    covered = torch.cat(depths)
    return float(covered.median()) if len(covered) else None
