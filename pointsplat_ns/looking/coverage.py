"""Coverage: the share of the visible content of a scene that some views show."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.each_view import each_view
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.system.tensors import INDICES
from pointsplat_ns.views import Views


@torch.no_grad()
def coverage(
    scene: Gaussians,
    views: Views,
    times: int = 2,
    side: int = 160,
    min_pixels: float = 0.05,
    samples: int = 96,
) -> float:
    """Share of the visible content that enough of the views show.

    The visible content are the Gaussians that any of these views shows, or any of the views that are sampled all around
    in the scene. Each Gaussian counts by its opacity times its area.

    Args:
        scene: N Gaussians on the CPU.
        views: C views.
        times: number of views that must show a Gaussian.
        side: longer side of the pictures in which a Gaussian is shown, pixels.
        min_pixels: smallest sum of its blend weights over the pixels of a picture.
        samples: number of sampled views.

    Returns:
        A share in [0, 1]; 0 if nothing is visible.
    """

    def views_that_show(views: Views) -> Tensor:  # number (N,) int64 for each Gaussian
        counts = torch.zeros(len(scene), **INDICES)
        for pixels in each_view(scene, views.resized(side), pixels_of):
            counts += pixels >= min_pixels
        return counts

    counts = views_that_show(views)
    visible = counts > 0
    try:
        visible |= views_that_show(sample_views(scene, samples, seed=96)) > 0
    except DataError:
        pass  # nothing is visible
    stds = scene.stds.double().nan_to_num(0.0, 0.0, 0.0).sort(dim=1).values
    mass = torch.where(visible, scene.alphas.double().nan_to_num(0.0) * stds[:, 1] * stds[:, 2], 0.0)
    if bool(visible.any()):
        ranked = mass[visible].sort().values
        mass = mass.clamp_max(ranked[int(LOOKING.max_area_quantile * (len(ranked) - 1))])
    total = float(mass.sum())
    return float(mass[counts >= times].sum()) / total if total > 0 else 0.0
