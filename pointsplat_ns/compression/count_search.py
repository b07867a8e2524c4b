"""One search for all budgets without a formula: PSNR of renders, size of a compressed file, time of a frame.

Each measure rises with the number of Gaussians, nearly linearly in the logarithm of the number. So the next count is
interpolated between a count below the target and one above it. As long as all tried counts lie on one side, it is
extrapolated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class SearchSettings:
    """When a search ends, and how it steps."""

    precision: float = 1.05
    """Largest ratio of a count that meets the target to the neighbouring one that misses it."""
    tolerance: float = 0.0
    """Distance from the target, in units of the measure, at which a count that meets the target is good enough."""
    tries: float = math.inf
    """Largest number of counts tried, once one has met the target."""
    step_up: float = 2.0
    """Factor to the next larger count where no slope is known."""
    step_down: float = 0.25
    """Factor to the next smaller count where no slope is known."""
    largest_step: float = 16.0
    """Largest factor between two counts in an extrapolation."""
    overshoot: float = 1.05
    """Factor on an extrapolated step, so that the next two counts enclose the target. 1 where there is a tolerance."""
    margin: float = 0.03
    """Share of the interval by which an interpolated count moves to the side that meets the target, so that the last
    count tried is likely to meet it. 0 where there is a tolerance."""
    inset: float = 0.15
    """Least distance of an interpolated count from both ends, as a share of the interval, so that each try narrows
    it."""


@dataclass(frozen=True)
class FoundCount:
    """The result of a search."""

    count: int | None
    """The best count that meets the target; None if none does."""
    slope: float | None
    """Rise of the measure for each e-fold of the count near the target; None if it is not known."""


def find_count(
    measure: Callable[[int], float],
    target: float,
    at_least: bool,
    first: int,
    most: int,
    least: int = 1,
    slope: float | None = None,
    settings: SearchSettings | None = None,
) -> FoundCount:
    """Search for the smallest count whose measure reaches the target, or the largest whose measure does not exceed it.

    Args:
        measure: from a count to a number that rises with it. It is called once for each count tried.
        target: the number to reach, or not to exceed.
        at_least: whether the measure has to reach the target; if not, it must not exceed it.
        first: the first count tried.
        most, least: bounds of the count.
        slope: rise of the measure for each e-fold of the count; None if it is not known.

    Example:
        >>> find_count(lambda count: count / 10, 42.0, at_least=True, first=1000, most=1000).count in range(420, 442)
        True
    """
    settings = settings or SearchSettings()
    aimed = target + (0.5 if at_least else -0.5) * settings.tolerance
    low, high = least - 1, most + 1  # counts below the target, and at or above it; out of bounds until measured
    values: dict[int, float] = {}
    best: int | None = None
    count = min(max(first, least), most)
    while True:
        value = values[count] = measure(count)
        below = value < target if at_least else value <= target
        low, high = (count, high) if below else (low, count)
        if below != at_least:
            best = count
        slope = _slope(values, target, slope)
        close = best is not None and high <= max(low, 1) * settings.precision
        good_enough = best == count and 0 < settings.tolerance >= abs(value - target)
        if close or good_enough or high - low <= 1 or (best is not None and len(values) >= settings.tries):
            return FoundCount(best, slope)
        if low in values and high in values:
            margin = 0.0 if settings.tolerance else settings.margin if at_least else -settings.margin
            guess = _interpolated(low, high, values[low], values[high], aimed, margin, settings)
        else:
            tried = low if low in values else high
            guess = _extrapolated(tried, aimed - values[tried], slope, tried == low, settings)
        if guess * settings.precision > most and most not in values:
            guess = most
        count = min(high - 1, max(low + 1, round(guess)))


def _interpolated(
    low: int, high: int, below: float, above: float, aimed: float, margin: float, settings: SearchSettings
) -> float:
    """The count where the line through two measured counts reaches ``aimed``, moved by a margin."""
    share = (aimed - below) / (above - below) + margin if math.isfinite(above - below) and above > below else 0.5
    return low * (high / low) ** min(1 - settings.inset, max(settings.inset, share))


def _extrapolated(tried: int, gap: float, slope: float | None, up: bool, settings: SearchSettings) -> float:
    """The count where the line through one measured count closes the gap to the target."""
    if slope is None or not math.isfinite(gap):
        return tried * (settings.step_up if up else settings.step_down)
    overshoot = 1.0 if settings.tolerance else settings.overshoot
    factor = overshoot * math.exp(min(abs(gap) / slope, math.log(settings.largest_step)))
    return tried * factor if up else tried / factor


def _slope(values: dict[int, float], target: float, known: float | None) -> float | None:
    """Rise for each e-fold between the two measured counts nearest to the target; None if it is not positive. With
    fewer than two counts, the known slope."""
    nearest = sorted((count for count in values if math.isfinite(values[count])), key=lambda n: abs(values[n] - target))
    if len(nearest) < 2:
        return known
    fewer, more = sorted(nearest[:2])
    slope = (values[more] - values[fewer]) / math.log(more / fewer)
    return slope if slope > 0 else None
