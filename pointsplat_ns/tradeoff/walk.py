"""Walks the front of a scene's trade: measures where it bends, and stops where it is flat.

A *way* is a method, an SH degree and a repair; along a way only the number of Gaussians changes. The walk looks at the
loss in dB (:mod:`~pointsplat_ns.tradeoff.loss`), which is the same at each run, and never at times, which are not.

1. The first way, the first method with all SH bands and no repair, at a tenth. Then each repair there. One that gains
   ``ACCEPTANCE.min_gain`` (:mod:`~pointsplat_ns.compression.acceptance`) over what came before it is used from here on.
2. This way at three tenths and at three hundredths.
3. A lower SH degree matters if leaving out its bands of the dense scene costs no more than merging to a tenth did: then
   the lowest such degree is measured at a tenth. If it loses less there than the first way does at the same size of the
   file, it is measured at the other two as well.
4. Other methods, if any were asked for, at these three.
5. Then, again and again: the gap between neighbours on a way (the dense scene is the upper end of each) whose losses
   differ most is halved, in the logarithm of the number of Gaussians. The gap that the wanted loss lies in counts
   :data:`AT_LIMIT` times. Other gaps of less than :data:`FLAT`, and all of counts within :data:`CLOSE`, are left; the
   walk ends when all are.

Then follow :func:`drawings`: some of these scenes, drawn faster.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from pointsplat_ns.compression.acceptance import ACCEPTANCE
from pointsplat_ns.pruning import resolve_keep
from pointsplat_ns.tradeoff.loss import loss_of, recommend
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import DRAWN, Drawn, Repair, Setting, setting_of

TRIAL, OTHERS = 0.1, (0.3, 0.03)
"""Share of the Gaussians at which ways are tried, and further shares that each way is measured at."""

FLAT = 0.25
"""Difference of losses, dB, below which a gap is flat: views chosen otherwise would change a loss by about as much."""

CLOSE = 1.1
"""Ratio of counts below which a gap is not halved."""

HALVINGS = 2
"""Scenes that are made to find the fewest Gaussians within the wanted loss when drawn fast."""

MOST_DRAWINGS = 1 + HALVINGS + 2
"""Largest number of settings that :func:`drawings` yields."""

AT_LIMIT = 6
"""Weight of the gap that the wanted loss lies in: what is recommended is known the better for it."""


@dataclass(frozen=True)
class Plan:
    """What may be tried of a scene."""

    count: int
    """Number of Gaussians in it."""
    sh_degree: int
    methods: tuple[str, ...] = ("merge",)
    repairs: tuple[Repair, ...] = ("none", "quick")
    within: float = 0.5
    """The wanted loss, dB."""
    drawn: tuple[Drawn, ...] = DRAWN


def walk(
    plan: Plan, measured: Mapping[Setting, Point], dense: Point, cut_psnr: Callable[[int], float]
) -> Iterator[Setting]:
    """The settings to measure, one after the other.

    Args:
        plan: what may be tried.
        measured: what was measured; a setting must be in it when the next one is asked for. The same measurements give
            the same walk, so that one that was interrupted goes on where it was.
        dense: the dense scene.
        cut_psnr: from an SH degree to the PSNR, dB, of the dense scene's renders without the bands above, against its
            own.

    Yields:
        Settings, each once.
    """
    trial, *others = dict.fromkeys(resolve_keep(plan.count, share) for share in (TRIAL, *OTHERS))

    def loss(setting: Setting) -> float:
        return loss_of(measured[setting], dense)

    way = Setting(trial, plan.sh_degree, plan.repairs[0], plan.methods[0])
    yield way
    for repair in plan.repairs[1:]:
        repaired = replace(way, repair=repair)
        yield repaired
        if loss(repaired) <= loss(way) - ACCEPTANCE.min_gain:
            way = repaired
    for count in others:
        yield replace(way, count=count)
    ways = [way]
    cut = _degree_worth_trying(plan.sh_degree, measured[way], cut_psnr)
    if cut is not None:
        cut_way = replace(way, sh_degree=cut)
        yield cut_way
        if loss(cut_way) < _loss_at(cut_way.bytes, [replace(way, count=count) for count in (trial, *others)], loss):
            for count in others:
                yield replace(cut_way, count=count)
            ways.append(cut_way)
    for method in plan.methods[1:]:
        for count in (trial, *others):
            yield replace(way, by=method, count=count)
    while (setting := _steepest(ways, measured, dense, plan)) is not None:
        yield setting


def drawings(plan: Plan, measured: Mapping[Setting, Point], dense: Point) -> Iterator[Setting]:
    """The settings to draw in other ways when the walk is over, at most :data:`MOST_DRAWINGS`.

    Of the scenes that are within the wanted loss, the one with the fewest Gaussians is drawn fast. If this loses too
    much, up to :data:`HALVINGS` larger ones are tried. At half the resolution nothing is sharp, which shows least where
    little is left: the best scenes of a tenth and three tenths are drawn so.

    Args:
        plan, measured, dense: as for :func:`walk`.

    Yields:
        Settings, each once.
    """
    exact = {setting: point for setting, point in measured.items() if setting.drawn == "exact"}
    fewest, _ = recommend([dense, *exact.values()], plan.within, trusted=False)
    if "fast" in plan.drawn and fewest is not dense:
        setting = replace(setting_of(fewest), drawn="fast")
        low, high = setting.count, plan.count
        yield setting
        for _ in range(HALVINGS):
            if loss_of(measured[setting], dense) <= plan.within:
                high = setting.count
            else:
                low = setting.count
            middle = round(math.sqrt(low * high))
            if high < CLOSE * low or middle in (low, high):
                break
            setting = replace(setting, count=middle)
            yield setting
    if "half" in plan.drawn:
        for count in sorted({resolve_keep(plan.count, share) for share in (TRIAL, OTHERS[0])}):
            scenes = [setting for setting in exact if setting.count == count]
            if scenes:
                yield replace(min(scenes, key=lambda setting: loss_of(exact[setting], dense)), drawn="half")


def _degree_worth_trying(degree: int, tried: Point, cut_psnr: Callable[[int], float]) -> int | None:
    """The lowest SH degree below ``degree`` whose lack alone costs no more than all that a point has lost."""
    return next((lower for lower in range(degree) if cut_psnr(lower) >= tried.against_dense.psnr), None)


def _loss_at(size: int, settings: list[Setting], loss: Callable[[Setting], float]) -> float:
    """The loss at a size of the file, in bytes, between settings of one way."""
    settings = sorted(settings, key=lambda setting: setting.bytes)
    sizes = [math.log(setting.bytes) for setting in settings]
    return float(np.interp(math.log(size), sizes, [loss(setting) for setting in settings]))


def _steepest(ways: list[Setting], measured: Mapping[Setting, Point], dense: Point, plan: Plan) -> Setting | None:
    """The middle of the gap to halve next; None if all are flat or close."""
    best, steepest = None, 0.0
    for way in ways:
        chain = {s.count: loss_of(point, dense) for s, point in measured.items() if replace(s, count=way.count) == way}
        counts = sorted({*chain, plan.count})
        for fewer, more in zip(counts, counts[1:], strict=False):
            low, high = chain[fewer], chain.get(more, 0.0)
            middle = round(math.sqrt(fewer * more))
            at_limit = high <= plan.within < low
            if (low - high < FLAT and not at_limit) or more < CLOSE * fewer or middle in (fewer, more):
                continue
            steep = (low - high) * (AT_LIMIT if at_limit else 1)
            if steep > steepest:
                best, steepest = replace(way, count=middle), steep
    return best
