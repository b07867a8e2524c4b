"""Visibility weight of each Gaussian, covered pixels per unit of its area, and its blur.

The weight weighs errors; the blur is the width that the rasterizer adds.

The covered pixels of a Gaussian are the sum of its blending weight, alpha times transmittance.
Divided by opacity and area, they are many near the cameras, few far away, and 0 behind a wall.

Renders are small. 3DGS rasterizers widen every projected Gaussian by 0.3 pixels, which would
overestimate Gaussians below the size of a pixel. The antialiased rasterizer lowers their opacity in
proportion, so its count is right.

While Gaussians are merged, they have that width: a point that is drawn as a pixel covers a pixel.
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
from pointsplat_ns.system.pieces import pieces
from pointsplat_ns.system.tensors import numbers
from pointsplat_ns.system.threads import parallel_map
from pointsplat_ns.view_sampling.content import UNITS, every_nth, in_units, views_in_units
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.traces import trace_factors

VIEWS_AT_ONCE = 4
"""Number of views whose covered pixels are in memory at a time, per thread."""


class Visibility(NamedTuple):
    """How views see n Gaussians."""

    weights: Tensor  # [n] float32, visibility weight of each per unit of area
    # [n] float32, variances in squared scene units that the rasterizer's blur adds; None for none
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
    return found, Visibility(weights, blurs)


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
    return Visibility(weights, None if blurs is None else blurs * (participants.size / UNITS) ** 2)


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
        views: of the scene, in its own unit.
        settings: ``visibility_views``, ``drawn_in_turn``, ``min_views_in_turn``,
            ``min_visibility`` and ``blur``.
        report: called with the share of the views done.

    Returns:
        Weights in [``min_visibility``, 1 / ``min_visibility``]; 1 for all if no view shows enough
        Gaussians. Blurs in the squared unit of the scene, at most the squared diagonal of its
        content; unseen Gaussians have the median.
    """
    seen = views.spread(settings.visibility_views)
    at_use = middle_sized(seen)
    small = replace(seen.resized(112), rasterize_mode="antialiased")
    turns = min(settings.drawn_in_turn, max(1, len(small) // settings.min_views_in_turn))
    blurs_count = settings.blur > 0 and not drawn_antialiased(scene, views)
    covered = torch.zeros(len(rows), dtype=torch.float64, device=scene.device)
    blurred = torch.zeros_like(covered)
    done = 0
    for turn in range(turns):
        drawn = every_nth(scene, rows[turn:], turns)
        in_turn = small[turn::turns]

        def look(these: slice, drawn: Gaussians = drawn, in_turn: Views = in_turn) -> Tensor:
            return pixels_of_each(drawn, in_turn[these])

        some = pieces(len(in_turn), scene.device, VIEWS_AT_ONCE)
        views_at_use = iter(at_use[turn::turns])
        for pixels in parallel_map(look, some, scene.device):
            for of_view, view in zip(pixels, views_at_use, strict=False):
                covered[turn::turns] += of_view
                if blurs_count:
                    blurred[turn::turns] += of_view * _blurs(drawn.means, view)
            done += len(pixels)
            report(done / len(small))
    blurs = None
    if blurs_count:
        blurs = torch.where(covered > 0, blurred / covered, math.nan)
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
    """Variances (n,) float64 that the blur of a view adds to Gaussians at ``means`` (n, 3), squared
    scene units."""
    row = view.viewmat[2].double().to(means.device)
    depths = means.double() @ row[:3] + row[3]
    squared_focal = float(view.K[0, 0]) * float(view.K[1, 1])
    return (depths.square() * (view.eps2d / squared_focal)).clamp_max(UNITS**2)
