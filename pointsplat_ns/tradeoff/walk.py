"""Chooses the settings of a sweep: measures the front where it bends, and stops where it is flat.

A *way* is a method, an SH degree and a repair; along a way only the number of Gaussians changes. The walk depends on
the loss in dB (:func:`~pointsplat_ns.tradeoff.front.loss_of`), which is the same in each run, and not on times.

1. The first way, which is the first method with all SH bands and no repair, at a tenth. Then each repair there. A
   repair with a gain of ``ACCEPTANCE.min_gain`` (:mod:`~pointsplat_ns.compression.acceptance`) becomes part of the way.
2. This way at three tenths and at three hundredths.
3. The lowest SH degree at which the dense scene loses no more than by merging to a tenth is measured at a tenth. If it
   loses less there than the first way at the same size of the file, it is measured at the other two shares too.
4. Other methods, if requested, at these three shares.
5. A search for the fewest Gaussians of the first way within the wanted loss.
6. Repeatedly: of all gaps between neighbours on a way (the dense scene is the upper end of each), the gap with the
   largest difference of losses is halved in the logarithm of the count, until all gaps are flat or close
   (:class:`WalkSettings`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace

import numpy as np

from pointsplat_ns.compression.acceptance import ACCEPTANCE
from pointsplat_ns.compression.budget_search import SearchSettings, find_count
from pointsplat_ns.pruning import resolve_keep
from pointsplat_ns.tradeoff.front import loss_of
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import Repair, Setting


@dataclass(frozen=True)
class WalkSettings:
    """Settings of the walk."""

    trial: float = 0.1
    """Share of the Gaussians at which ways are tried."""
    others: tuple[float, float] = (0.3, 0.03)
    """Further shares for each way."""
    flat: float = 0.25
    """Difference of losses in dB below which a gap is flat: another choice of views changes a loss by as much."""
    close: float = 1.1
    """Ratio of counts below which a gap is not halved."""


WALK = WalkSettings()

Measure = Callable[[Setting], Point]
"""From a setting to its point; deterministic."""


class Enough(Exception):
    """Raised by a measure to end a walk."""


@dataclass(frozen=True)
class Plan:
    """Settings that a walk or a search may try."""

    count: int
    """Number of Gaussians in the dense scene."""
    sh_degree: int
    methods: tuple[str, ...] = ("merge",)
    repairs: tuple[Repair, ...] = ("none", "quick")
    within: float = 0.5
    """The wanted loss, dB."""


def measure_walk(plan: Plan, measure: Measure, dense: Point, cut_psnr: Callable[[int], float]) -> None:
    """Measure settings, one after the other, until all gaps are flat or the measure raises :class:`Enough`.

    ``measure`` is called for one setting more than once. The same points give the same walk, so that an interrupted
    walk can continue. ``cut_psnr`` gives, by SH degree, the PSNR in dB of the dense scene's renders without the bands
    above, against all bands.
    """
    trial, *others = counts = [*dict.fromkeys(resolve_keep(plan.count, share) for share in (WALK.trial, *WALK.others))]
    losses: dict[Setting, float] = {}

    def loss(setting: Setting) -> float:
        if setting not in losses:
            losses[setting] = loss_of(measure(setting), dense)
        return losses[setting]

    with suppress(Enough):
        way = Setting(trial, plan.sh_degree, plan.repairs[0], plan.methods[0])
        loss(way)
        for repair in plan.repairs[1:]:
            repaired = replace(way, repair=repair)
            if loss(repaired) <= loss(way) - ACCEPTANCE.min_gain:
                way = repaired
        for count in others:
            loss(replace(way, count=count))
        ways = [way]
        cut = next((d for d in range(plan.sh_degree) if cut_psnr(d) >= measure(way).against_dense.psnr), None)
        if cut is not None:
            cut_way = replace(way, sh_degree=cut)
            if loss(cut_way) < _loss_at(cut_way.bytes, {s: losses[s] for s in (replace(way, count=n) for n in counts)}):
                for count in others:
                    loss(replace(cut_way, count=count))
                ways.append(cut_way)
        for method in plan.methods[1:]:
            for count in counts:
                loss(replace(way, by=method, count=count))
        _search(way, counts, loss, plan)
        while (setting := _steepest(ways, losses, plan.count)) is not None:
            loss(setting)


def _search(way: Setting, counts: list[int], loss: Callable[[Setting], float], plan: Plan) -> None:
    """Search along a way for the count with the wanted loss, between the known counts and the dense scene."""

    def gain(count: int) -> float:
        return -(loss(replace(way, count=count)) if count < plan.count else 0.0)

    known = sorted(counts)
    first = next((count for count in known if gain(count) >= -plan.within), known[-1])
    close = SearchSettings(precision=WALK.close)
    find_count(gain, -plan.within, at_least=True, first=first, most=plan.count, least=known[0], settings=close)


def _loss_at(size: int, losses: Mapping[Setting, float]) -> float:
    """The loss at a size of the file in bytes, interpolated between settings of one way."""
    settings = sorted(losses, key=lambda setting: setting.bytes)
    sizes = [math.log(setting.bytes) for setting in settings]
    return float(np.interp(math.log(size), sizes, [losses[setting] for setting in settings]))


def _steepest(ways: list[Setting], losses: Mapping[Setting, float], whole: int) -> Setting | None:
    """The middle of the next gap to halve; None if all gaps are flat or close."""
    best, steepest = None, WALK.flat
    for way in ways:
        chain = {s.count: loss for s, loss in losses.items() if replace(s, count=way.count) == way} | {whole: 0.0}
        counts = sorted(chain)
        for fewer, more in zip(counts, counts[1:], strict=False):
            middle = round(math.sqrt(fewer * more))
            if chain[fewer] - chain[more] >= steepest and more >= WALK.close * fewer and middle not in (fewer, more):
                best, steepest = replace(way, count=middle), chain[fewer] - chain[more]
    return best
