"""One search for all budgets without a formula: PSNR of renders, and size of a compressed file.

Each measure rises with the number of Gaussians, nearly linearly in the logarithm of the number. So
the next count is interpolated between a count below the target and one above it. As long as all
tried counts lie on one side, it is extrapolated.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Generic, TypeVar

import torch

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.scene.formats import Format
from pointsplat_ns.scene.formats.rounding import rounding_for
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.progress import silent

SLOPE = 6.0
"""Usual gain of merged scenes for each e-fold of the count, dB."""

Made = TypeVar("Made")


@dataclass(frozen=True, eq=False)
class Found(Generic[Made]):
    """The result of a search."""

    best: Made | None
    """What was made with the best count; None if all counts miss the target."""
    tried: dict[int, float]
    """The measure by count, for every count tried."""
    interrupted: bool
    """Whether Ctrl-C ended the search."""


def find_count(
    measure: Callable[[int], tuple[float, Made]],
    target: float,
    at_least: bool,
    first: int,
    most: int,
    slope: float,
    tolerance: float,
    tries: float = math.inf,
    stoppable: bool = False,
) -> Found[Made]:
    """Search for nearly the smallest count whose measure reaches the target, or nearly the largest
    whose measure does not exceed it. Of the counts tried, the best one that meets the target is
    found.

    Args:
        measure: from a count to a number that rises with it, and what was made with the count. It
            is called once for each count tried.
        target: the number to reach, or not to exceed.
        at_least: whether the measure has to reach the target; if not, it must not exceed it.
        first: the first count tried.
        most: largest count.
        slope: usual rise of the measure for each e-fold of the count.
        tolerance: distance from the target at which a count that meets it is good enough. So is one
            within 5 % of a count that misses it.
        tries: largest number of counts tried, once one has met the target.
        stoppable: whether Ctrl-C ends the search with the best so far, if a count has met the
            target.

    Example:
        >>> found = find_count(lambda k: (k / 10, k), 42.0, True, first=1000, most=1000, slope=42.0, tolerance=1.0)
        >>> found.best in range(420, 442)
        True
    """
    aimed = target + (0.5 if at_least else -0.5) * tolerance
    # counts below the target, and at or above it; out of bounds until measured
    low = 0
    high = most + 1
    values: dict[int, float] = {}
    best: tuple[int, Made] | None = None
    count = min(max(first, 1), most)
    while True:
        try:
            value, made = measure(count)
        except KeyboardInterrupt:
            if best is None or not stoppable:
                raise
            return Found(best[1], values, True)
        values[count] = value
        below = value < target if at_least else value <= target
        low, high = (count, high) if below else (low, count)
        if below != at_least:
            best = count, made
        good_enough = best is not None and best[0] == count and abs(value - target) <= tolerance
        close = best is not None and high <= max(low, 1) * 1.05
        if good_enough or close or high - low <= 1 or (best is not None and len(values) >= tries):
            return Found(None if best is None else best[1], values, False)
        guess = _guess(values, aimed, slope)
        if (
            low in values and high in values
        ):  # apart from both, so that each try narrows the interval
            guess = min(low * (high / low) ** 0.85, max(low * (high / low) ** 0.15, guess))
        elif guess * 1.05 > most and most not in values:
            guess = most
        count = min(high - 1, max(low + 1, round(guess)))


def _guess(values: dict[int, float], aimed: float, slope: float) -> float:
    """The count where the line through the two measured counts nearest to ``aimed`` reaches it;
    with one count, or if the measure falls between them, a line of the usual slope. It is at most
    16 times as far as the nearest."""
    nearest = sorted(
        (count for count in values if math.isfinite(values[count])),
        key=lambda n: abs(values[n] - aimed),
    )
    if not nearest:
        return min(values) / 4
    if len(nearest) > 1:
        fewer, more = sorted(nearest[:2])
        found = (values[more] - values[fewer]) / math.log(more / fewer)
        slope = found if found > 0 else slope
    step = (aimed - values[nearest[0]]) / slope
    return nearest[0] * math.exp(min(max(step, -math.log(16.0)), math.log(16.0)))


def share_done(tries: float) -> float:
    """Share done of a search after some tries, of which there are about four. It never jumps."""
    return 1 - 0.75**tries


@dataclass(frozen=True)
class FileLimit:
    """A limit of the size of a compressed file, and how far the numbers of its scene are rounded to
    meet it."""

    kind: Format
    """A format with ``encode``."""
    most: float
    """Bytes; inf for a rounding without a limit."""
    rounding: float | None = None
    """That of :func:`rounding_for` for a scene of this quality; None for none, as long as the file
    meets the limit."""

    def bytes_of(self, scene: Gaussians) -> int:
        """Bytes of a scene's file, without unusable Gaussians."""
        assert self.kind.encode is not None
        return len(self.kind.encode(_as_written(scene), silent))

    def rounded(self, scene: Gaussians) -> Gaussians:
        """A scene rounded so that its file meets the limit, on its device: coarser if the file is
        too large, finer if there is room. If no rounding that is tried meets it, the last is
        returned."""
        if self.kind.rounded is None:
            return scene
        written = _as_written(scene)
        rounding = self.rounding
        if rounding is None:
            if self.most == math.inf or self.bytes_of(written) <= self.most:
                return scene
            rounding = rounding_for(math.inf, scene.sh_degree)
        best = tried = self.kind.rounded(written, rounding)
        if self.most == math.inf:
            return best.to(scene.device)
        # steps finer: those tried, the most that fit, the next
        steps = 0.0
        fits = -math.inf
        exceeds = math.inf
        for number in range(6):
            tried = self.kind.rounded(written, rounding * 2 ** (-0.5 * steps)) if number else tried
            room = math.log(self.most / self.bytes_of(tried))
            if room >= 0:
                best = tried
                fits = steps
            else:
                exceeds = steps
            if 0 <= room <= 0.05:
                break
            steps += (room - 0.025) / 0.12  # a step finer usually makes a file larger by 12 %
            if not fits < steps < exceeds:
                steps = 0.5 * (fits + exceeds)
        return (best if fits > -math.inf else tried).to(scene.device)


def _as_written(scene: Gaussians) -> Gaussians:
    scene = scene.detach().to("cpu", torch.float32)
    return scene[scene.usable()]


def smallest_within(
    n: int,
    measure: Callable[[int], tuple[float, Made]],
    psnr: float,
    stoppable: bool = False,
    first: float = 0.3,
    slope: float = SLOPE,
) -> tuple[Made, Found[Made]]:
    """Search for the smallest scene of a method that reaches ``psnr``, dB. A smaller such scene may
    exist where PSNR does not always rise with the count.

    Args:
        n: number of Gaussians of the dense scene.
        measure: from a count, at most n, to the PSNR of a scene against the dense one, dB, and what
            was made.
        psnr: to be reached, dB, above 0.
        stoppable, slope: as for :func:`find_count`.
        first: share of n that is tried first.

    Returns:
        What was made with the best count, and the search.

    Raises:
        BudgetError: if not even n Gaussians reach it.
    """
    found = find_count(
        measure, psnr, True, max(1, round(first * n)), n, slope, tolerance=0.1, stoppable=stoppable
    )
    if found.best is None:
        raise BudgetError(
            f"all {n} Gaussians reach {found.tried[n]:.1f} dB, not {psnr:.4g} dB; ask for less"
        )
    return found.best, found


def largest_within(
    full: Gaussians,
    make: Callable[[int], Gaussians],
    limit: FileLimit,
    progress: Callable[[float], None],
    psnr_of: Callable[[Gaussians], float] | None = None,
) -> tuple[Gaussians, FileLimit, int]:
    """Search for the largest scene of a method whose file meets a limit. The numbers of each scene
    are rounded by its PSNR, unless all Gaussians fit without. Each try makes a scene, so tries are
    few, and 95 % of the limit are enough.

    Args:
        full: the largest scene.
        make: ``make(n)`` returns n Gaussians, fewer than ``full`` has.
        limit: of the file, without rounding.
        progress: called with the share done.
        psnr_of: gives the PSNR of a scene, dB; None where there are no views: it is then taken to
            be 30 dB.

    Returns:
        The scene before its numbers are rounded; the limit with a rounding that meets it; and the
        number of tries.

    Raises:
        BudgetError: if not even one Gaussian fits.
    """
    n = len(full)
    numbers = itertools.count(1)

    def measure(count: int) -> tuple[float, tuple[Gaussians, FileLimit]]:
        scene = full if count == n else make(count)
        written = _as_written(scene)
        found = limit
        if limit.kind.rounded is not None:
            psnr = few_psnr(psnr_of(scene) if psnr_of else 30.0, count / n)
            rounding = rounding_for(psnr, full.sh_degree)
            written = limit.kind.rounded(written, rounding)
            found = replace(limit, rounding=rounding)
        size = limit.bytes_of(written)
        if (
            size <= limit.most
            and count == n
            and found.rounding
            and limit.bytes_of(full) <= limit.most
        ):
            found = limit
        progress(share_done(next(numbers)))
        return math.log(size), (scene, found)

    first = round(limit.most / 15)  # few Gaussians take less than 15 bytes each
    found = find_count(
        measure, math.log(max(limit.most, 1)), False, first, n, 1.0, -math.log(0.95), tries=4
    )
    if found.best is None:
        raise BudgetError(
            f"keep is {limit.most / 1e6:g}MB{limit.kind.suffix}, too small for one Gaussian; "
            f"expected at least {round(math.exp(found.tried[1])) / 1e6:g}MB"
        )
    return *found.best, len(found.tried)


def few_psnr(psnr: float, kept: float) -> float:
    """PSNR by which the numbers of a scene are rounded that has a PSNR, dB, with a share ``kept``
    of the Gaussians.

    The squared error of merging is taken as A (kept^-p - 1): it falls by ``SLOPE`` for each e-fold
    of a small count, and to 0 for all Gaussians. A Gaussian more gains the more, the nearer to all
    they are, so that rounding may cost more: at the best division of bytes, its error is a share of
    A kept^-p, which few Gaussians have.
    """
    return psnr + 10 * math.log10(1 - kept ** (SLOPE * math.log(10) / 10)) if kept < 1 else psnr
