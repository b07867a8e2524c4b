"""Coverage: the share of what can be seen of a scene that some views show."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.each_view import each_view
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.views import Views

SIDE = 160
"""Longer side of the pictures that are counted in, pixels."""

SEEN_PIXELS = 0.05
"""Pixels, opacity and what stands in front taken into account, from which on a Gaussian is seen in a picture."""

ANYWHERE = 96
"""Number of sampled views that tell what can be seen at all, in addition to the views in question."""


@torch.no_grad()
def coverage(scene: Gaussians, views: Views, times: int = 2) -> float:
    """Share of the visible content that at least some of the views show.

    The visible content is what any of these views, or of others all about the scene, shows. Each Gaussian counts by its
    opacity times the area of its broad side.

    Args:
        scene: N Gaussians on the CPU.
        views: C views.
        times: number of views that must show a Gaussian.

    Returns:
        A share in [0, 1]; 0 if nothing can be seen.
    """
    counts = _times_seen(scene, views)
    visible = counts > 0
    try:
        visible |= _times_seen(scene, sample_views(scene, ANYWHERE, seed=ANYWHERE)) > 0
    except DataError:
        pass  # there is no free place: what the views show is all that is known to be visible
    stds = scene.stds.double().nan_to_num(0.0, 0.0, 0.0).sort(dim=1).values
    mass = torch.where(visible, scene.alphas.double().nan_to_num(0.0) * stds[:, 1] * stds[:, 2], 0.0)
    if bool(visible.any()):  # a few giants must not count for all
        ranked = mass[visible].sort().values
        mass = mass.clamp_max(ranked[int(0.99 * (len(ranked) - 1))])
    total = float(mass.sum())
    return float(mass[counts >= times].sum()) / total if total > 0 else 0.0


def _times_seen(scene: Gaussians, views: Views) -> Tensor:
    """Number of views that show each Gaussian, (N,) int64."""
    counts = torch.zeros(len(scene), dtype=torch.int64)
    for pixels in each_view(list(views.resized(SIDE)), len(scene), lambda view: pixels_of(scene, view)):
        counts += pixels >= SEEN_PIXELS
    return counts
