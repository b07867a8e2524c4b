"""Fill (overdraw): number of Gaussians that viewers draw per pixel."""

from __future__ import annotations

import torch

from pointsplat_ns.rendering.constants import ALPHA_MIN
from pointsplat_ns.rendering.projection import project_scene
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views


@torch.no_grad()
def fill(scene: Gaussians, views: Views, max_count: int = 100_000) -> float:
    """Mean number of Gaussians drawn per pixel (overdraw).

    Counted as GPU viewers draw: each Gaussian is a rectangle along the axes of its ellipse. It
    extends sqrt(8) standard deviations to each side, or less if alpha reaches 1/255 before. There
    is no early termination. A rectangle that is partly inside of the image counts by the share of
    its axis-aligned bounding box inside.

    Args:
        scene: N Gaussians.
        views: at least one view.
        max_count: maximum number of projected Gaussians; in larger scenes, every k-th represents k.
    """
    each = max(-(-len(scene) // max_count), 1)
    sample = scene[::each]
    pixels = 0.0
    for view in views:
        seen = project_scene(sample, view)
        # [M] standard deviations
        reach = (2 * (seen.opacities / ALPHA_MIN).log()).clamp(0, 8).sqrt()
        area = 4 * reach.square() * seen.det.sqrt()  # [M] pixels
        half = reach[:, None] * seen.cov2d[:, [0, 2]].sqrt()  # [M, 2] of the bounding box
        size = half.new_tensor([view.width, view.height])
        low = seen.means2d - half
        high = seen.means2d + half
        inside = (high.minimum(size) - low.clamp_min(0)).clamp_min(0) / (high - low)
        pixels += float((area * inside.prod(dim=1)).double().sum())
    drawn = sum(size.width * size.height for size in views.size_of_each())
    return pixels * len(scene) / max(len(sample), 1) / drawn
