"""Visibility weight of each Gaussian, covered pixels per unit of its area, and its blur.

The weight weighs errors; the blur is the width that the rasterizer adds.

The covered pixels of a Gaussian are the sum of its blending weight, alpha times transmittance.
Divided by opacity and area, they are many near the cameras, few far away, and 0 behind a wall.

Renders are small. 3DGS rasterizers widen every projected Gaussian by 0.3 pixels, which would
overestimate Gaussians below the size of a pixel. The antialiased rasterizer lowers their opacity in
proportion, so its count is right.

If most Gaussians of a scene are narrower than their blur, they have that width while they are
merged: a point that is drawn as a pixel covers a pixel.
At depth z and focal length f, pixels, the variance of 0.3 pixels^2 is 0.3 (z / f)^2 in space. The
blur of a Gaussian is the mean over views, by covered pixels; its pixels are those of the middle
size (:func:`~pointsplat_ns.rendering.comparison.sizes.sides_of`). After merging, the blur is
subtracted. Antialiased scenes have none.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings
from pointsplat_ns.pruning.merging.state import Participants
from pointsplat_ns.rendering import pixels_of_each
from pointsplat_ns.rendering.comparison.sizes import middle_sized
from pointsplat_ns.rendering.projection import drawn_antialiased
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.tensors import numbers
from pointsplat_ns.view_sampling.content import UNITS, every_nth, in_units, views_in_units
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.traces import trace_factors

COUNT_AT_ONCE = 2_000_000
"""Maximum number of Gaussians, summed over the views that are drawn at once, for memory."""


class Visibility(NamedTuple):
    """How views see n Gaussians."""

    weights: Tensor  # [n] float32, visibility weight of each per unit of area
    # [n] float32 in [0, 1], variance that the rasterizer's blur adds, in units of the squared size
    # of the scene's content, so that it is finite for any unit; None for none
    blurs: Tensor | None = None


def views_and_weights(
    participants: Participants,
    views: Views | Sampler | None,
    settings: MergeSettings,
    report: Callable[[float], None] = lambda share: None,
) -> tuple[Views | None, Visibility]:
    """The views for visibility, and the visibility of n participants, its weights multiplied by
    trace factors if these apply. Arguments are those of :func:`views_to_weigh` and
    :func:`visibility_of`."""
    found, traced = views_to_weigh(len(participants), views, settings)
    report(0.6)
    weights, blurs = visibility_of(
        participants, found, settings, lambda share: report(0.6 + 0.4 * share)
    )
    if traced:
        weights = weights * trace_factors(participants.scene, participants.members)
    return found, Visibility(weights, blurs_that_count(participants, blurs))


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


def visibility_of(
    participants: Participants,
    views: Views | None,
    settings: MergeSettings,
    report: Callable[[float], None] = lambda share: None,
) -> Visibility:
    """The visibility of participants, from every n-th one along the curve. Without views, weights
    are 1 and there is no blur.

    Args:
        participants: n Gaussians.
        views: of their scene, in its unit.
        settings: ``max_count_drawn`` and those of :func:`visibility_in`.
        report: called with the share done.
    """
    scene = participants.scene
    members = participants.members
    if views is None:
        return Visibility(torch.ones_like(members, dtype=torch.float32))
    step = drawn_step(len(members), settings)
    rows = members if step == 1 else numbers(-(-len(members) // step), members.device)
    unit = participants.centre, participants.size
    drawn = in_units(scene if step == 1 else every_nth(scene, members, step), *unit)
    weights, blurs = (
        each if each is None else each.repeat_interleave(step)[: len(members)]
        for each in visibility_in(drawn, rows, views_in_units(views, *unit), settings, report)
    )
    assert weights is not None
    return Visibility(weights, blurs)


def blurs_that_count(participants: Participants, blurs: Tensor | None) -> Tensor | None:
    """The blurs (n,) if most of n participants are narrower than theirs along the middle axis, as
    points and needles below a pixel are; else None.

    In other scenes blur gains 0.1 to 0.3 dB (a rock, a bouquet, a bathroom) or loses 0.3 (a
    kitchen), at 10 and 30 %.
    """
    if blurs is None:
        return None
    middle = participants.scene.scales[participants.members].double().median(dim=1).values
    variances = 2 * (middle - math.log(participants.size))  # logarithms, of the unit of blurs
    narrower = variances < blurs.double().log()
    return blurs if bool(narrower.double().mean() > 0.5) else None


def drawn_step(count: int, settings: MergeSettings) -> int:
    """Step n such that every n-th of ``count`` Gaussians along the curve is drawn."""
    return -(-count // settings.max_count_drawn)


def visibility_in(
    scene: Gaussians,
    rows: Tensor,
    views: Views,
    settings: MergeSettings = MERGING,
    report: Callable[[float], None] = lambda share: None,
) -> Visibility:
    """Visibility of rows: covered pixels over opacity times area, relative to a clearly visible
    Gaussian; and blurs.

    Args:
        scene: N Gaussians.
        rows: (n,) indices, n at least 1.
        views: of the scene, in its own unit, of which its content is ``UNITS``.
        settings: ``visibility_views``, ``min_visibility`` and ``blur``.
        report: called with the share of the views done.

    Returns:
        Weights in [``min_visibility``, 1 / ``min_visibility``]; 1 for all if no view shows enough
        Gaussians. Unseen Gaussians have the median blur.
    """
    seen = views.spread(settings.visibility_views)
    small = replace(seen.resized(112), rasterize_mode="antialiased")
    at_use = middle_sized(seen)
    blurs_count = settings.blur > 0 and not drawn_antialiased(scene, views)
    covered = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)
    blurred = torch.zeros_like(covered)
    at_once = max(2, COUNT_AT_ONCE // len(scene))
    for first in range(0, len(small), at_once):
        for number, pixels in enumerate(
            pixels_of_each(scene, small[first : first + at_once]), first
        ):
            covered += pixels
            if blurs_count:
                blurred += pixels * _blurs(scene.means, at_use[number])
        report(min(first + at_once, len(small)) / len(small))
    covered = covered[rows]
    blurs = None
    if blurs_count:
        blurs = torch.where(covered > 0, blurred[rows] / covered, math.nan)
        blurs = blurs.nan_to_num(float(blurs.nanmedian().nan_to_num(0.0))).float()
        blurs = settings.blur * blurs
    stds = scene.stds[rows].double().sort(dim=1).values
    area = (scene.alphas[rows].double() * stds[:, 1] * stds[:, 2]).nan_to_num(0.0, 0.0, 0.0)
    ratios = covered / area.clamp_min(torch.finfo(torch.float64).tiny)
    well_seen = ratios.sort().values[int(0.9 * (len(ratios) - 1))]
    if not 0 < float(well_seen) < math.inf:
        return Visibility(torch.ones_like(ratios, dtype=torch.float32), blurs)
    weights = (ratios / well_seen).clamp(settings.min_visibility, 1 / settings.min_visibility)
    return Visibility(weights.float(), blurs)


def _blurs(means: Tensor, view: View) -> Tensor:
    """Variances (n,) float64 in [0, 1] that the blur of a view adds to Gaussians, in units of the
    squared size of the content; their ``means`` (n, 3) are in ``UNITS``."""
    row = view.viewmat[2].double().to(means.device)
    depths = means.double() @ row[:3] + row[3]
    squared_focal = float(view.K[0, 0]) * float(view.K[1, 1])
    return (depths.square() * (view.eps2d / squared_focal / UNITS**2)).clamp_max(1.0)
