"""One search for all budgets that only trying can meet: quality of renders, size of a compressed file, time of a frame.

Each of them rises with the number of Gaussians, nearly in a straight line over the logarithm of the number. So the next
count to try is found by interpolation between a count below the target and one above it, or by extrapolation as long as
all tried lie on one side.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class SearchSettings:
    """When a search ends."""

    precision: float = 1.05
    """Largest ratio of a count that meets the target to the neighbouring one that misses it."""
    tolerance: float = 0.0
    """Distance from the target, in units of the measure, at which a count that meets the target is good enough."""
    tries: float = math.inf
    """Largest number of counts that are tried once one has met the target."""


STEP_UP, STEP_DOWN = 2.0, 0.25
"""Factors to the next count, where nothing is known about how fast the measure rises."""

LARGEST_STEP = 16.0
"""Largest factor between two counts in an extrapolation."""

BEYOND = 1.05
"""Factor by which extrapolations go beyond the target, so that it lies between two counts afterwards."""

INSIDE = 0.03
"""Share of the interval by which an interpolated count is moved to the side that meets the target, so that the last
count tried is likely to meet it."""

NEAREST = 0.15
"""Least distance of an interpolated count from the ends, as a share of the interval, so that each try narrows it."""


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
    """Search for the smallest count whose measure is at least the target, or the largest whose measure is at most that.

    Args:
        measure: from a count to a number that rises with it. It is called once for each count that is tried.
        target: the number to reach, or not to exceed.
        at_least: whether the target is to be reached. If not, it is not to be exceeded.
        first: the count that is tried first.
        most, least: bounds of the count.
        slope: rise of the measure for each e-fold of the count, if it is known.
        settings: when the search ends.

    Example:
        >>> find_count(lambda count: count / 10, 42.0, at_least=True, first=1000, most=1000).count in range(420, 442)
        True
        >>> find_count(lambda count: count / 10, 42.0, at_least=False, first=1000, most=1000).count in range(400, 421)
        True
    """
    settings = settings or SearchSettings()
    aimed = target + (0.5 if at_least else -0.5) * settings.tolerance
    low, high = least - 1, most + 1  # below the target, and above it or at it; as long as not measured, out of bounds
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
            inside = 0.0 if settings.tolerance else INSIDE if at_least else -INSIDE
            guess = _between(low, high, values[low], values[high], aimed, inside)
        else:
            tried = low if low in values else high
            beyond = 1.0 if settings.tolerance else BEYOND
            guess = _outside(tried, aimed - values[tried], slope, tried == low, beyond)
        if guess * settings.precision > most and most not in values:
            guess = most
        count = min(high - 1, max(low + 1, round(guess)))


def _between(low: int, high: int, below: float, above: float, aimed: float, inside: float) -> float:
    """The count where a straight line through two measured ones is at the number that is aimed at."""
    share = (aimed - below) / (above - below) + inside if math.isfinite(above - below) and above > below else 0.5
    return low * (high / low) ** min(1 - NEAREST, max(NEAREST, share))


def _outside(tried: int, gap: float, slope: float | None, up: bool, beyond: float) -> float:
    """The count where a straight line through a measured one closes a gap, and a little further."""
    if slope is None or not math.isfinite(gap):
        return tried * (STEP_UP if up else STEP_DOWN)
    factor = beyond * math.exp(min(abs(gap) / slope, math.log(LARGEST_STEP)))
    return tried * factor if up else tried / factor


def _slope(values: dict[int, float], target: float, known: float | None) -> float | None:
    """Rise for each e-fold between the two measured counts that are nearest to the target, None if there is none; what
    was known before, if fewer were measured."""
    nearest = sorted((count for count in values if math.isfinite(values[count])), key=lambda n: abs(values[n] - target))
    if len(nearest) < 2:
        return known
    fewer, more = sorted(nearest[:2])
    slope = (values[more] - values[fewer]) / math.log(more / fewer)
    return slope if slope > 0 else None
