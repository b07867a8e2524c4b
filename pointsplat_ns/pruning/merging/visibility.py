"""Visibility weight of each Gaussian: covered pixels per unit of its area. Weights errors.

The covered pixels of a Gaussian are the sum of its blending weight, alpha times transmittance.
Divided by opacity and area, they are many near the cameras, few far away, and 0 behind a wall.

Renders are small. 3DGS rasterizers widen every projected Gaussian by 0.3 pixels, which would
overestimate Gaussians below the size of a pixel. The antialiased rasterizer lowers their opacity in
proportion, so its count is right.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings
from pointsplat_ns.pruning.merging.state import Participants
from pointsplat_ns.rendering import pixels_of_each
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.tensors import numbers
from pointsplat_ns.view_sampling.content import every_nth, in_units, views_in_units
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.traces import trace_factors

COUNT_AT_ONCE = 2_000_000
"""Maximum number of Gaussians, summed over the views that are drawn at once, for memory."""


def views_and_weights(
    participants: Participants,
    views: Views | Sampler | None,
    settings: MergeSettings,
    report: Callable[[float], None] = lambda share: None,
) -> tuple[Views | None, Tensor]:
    """The views for visibility, and the visibility weights (n,) of participants, multiplied by
    trace factors if these apply. Arguments are those of :func:`views_to_weigh` and
    :func:`visibility_weights`."""
    found, traced = views_to_weigh(len(participants), views, settings)
    report(0.6)
    weights = visibility_weights(
        participants, found, settings, lambda share: report(0.6 + 0.4 * share)
    )
    return found, weights * trace_factors(
        participants.scene, participants.members
    ) if traced else weights


def views_to_weigh(
    count: int, views: Views | Sampler | None, settings: MergeSettings
) -> tuple[Views | None, bool]:
    """The views for visibility, and whether trace factors
    (:mod:`~pointsplat_ns.view_sampling.traces`) apply.

    Args:
        count: number of Gaussians to merge.
        views: known views, or the sampler of likely ones.
        settings: ``min_count_rendered``, ``sampled_views`` and ``view_seed``.

    Returns:
        No views for a small scene without known ones, if nothing is visible, or if the number of
        sampled views is 0.
    """
    if isinstance(views, Views):
        return views, False
    if views is not None and count >= settings.min_count_rendered:
        with contextlib.suppress(DataError):
            return views.views(settings.sampled_views, settings.view_seed), views.traced
    return None, False


def visibility_weights(
    participants: Participants,
    views: Views | None,
    settings: MergeSettings,
    report: Callable[[float], None] = lambda share: None,
) -> Tensor:
    """The visibility weights (n,) of participants, from every n-th one along the curve; 1 without
    views.

    Args:
        participants: n Gaussians.
        views: of their scene, in its unit.
        settings: ``max_count_drawn`` and those of :func:`covered_per_area`.
        report: called with the share done.
    """
    scene = participants.scene
    members = participants.members
    if views is None:
        return torch.ones_like(members, dtype=torch.float32)
    step = drawn_step(len(members), settings)
    rows = members if step == 1 else numbers(-(-len(members) // step), members.device)
    unit = participants.centre, participants.size
    drawn = in_units(scene if step == 1 else every_nth(scene, members, step), *unit)
    each = covered_per_area(drawn, rows, views_in_units(views, *unit), settings, report)
    return each.repeat_interleave(step)[: len(members)]


def drawn_step(count: int, settings: MergeSettings) -> int:
    """Step n such that every n-th of ``count`` Gaussians along the curve is drawn."""
    return -(-count // settings.max_count_drawn)


def covered_per_area(
    scene: Gaussians,
    rows: Tensor,
    views: Views,
    settings: MergeSettings = MERGING,
    report: Callable[[float], None] = lambda share: None,
) -> Tensor:
    """Covered pixels of rows over opacity times area, relative to a clearly visible Gaussian.

    Args:
        scene: N Gaussians.
        rows: (n,) indices, n at least 1.
        views: of the scene, in its own unit.
        settings: ``visibility_views`` and ``min_visibility``.
        report: called with the share of the views done.

    Returns:
        (n,) float32 in [``min_visibility``, 1 / ``min_visibility``]; 1 for all if no view shows
        enough Gaussians.
    """
    covered = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)
    small = views.spread(settings.visibility_views).resized(112)
    small = replace(small, rasterize_mode="antialiased")
    at_once = max(2, COUNT_AT_ONCE // len(scene))
    for first in range(0, len(small), at_once):
        for pixels in pixels_of_each(scene, small[first : first + at_once]):
            covered += pixels
        report(min(first + at_once, len(small)) / len(small))
    stds = scene.stds[rows].double().sort(dim=1).values
    area = (scene.alphas[rows].double() * stds[:, 1] * stds[:, 2]).nan_to_num(0.0, 0.0, 0.0)
    ratios = covered[rows] / area.clamp_min(torch.finfo(torch.float64).tiny)
    well_seen = ratios.sort().values[int(0.9 * (len(ratios) - 1))]
    if not 0 < float(well_seen) < math.inf:
        return torch.ones_like(ratios, dtype=torch.float32)
    return (ratios / well_seen).clamp(settings.min_visibility, 1 / settings.min_visibility).float()
