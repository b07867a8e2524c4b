"""One search for all budgets without a formula: PSNR of renders, size of a compressed file, time of a frame.

Each measure rises with the number of Gaussians, nearly linearly in the logarithm of the number. So the next count is
interpolated between a count below the target and one above it. As long as all tried counts lie on one side, it is
extrapolated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch

from pointsplat_ns.comparing.closeness import DenseReference
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats import Format
from pointsplat_ns.io.formats.rounding import rounding_for
from pointsplat_ns.pruning.sh_bands import cut_sh
from pointsplat_ns.system.progress import silent
from pointsplat_ns.views import Views

FIRST_SHARE = 0.3
"""Share of the Gaussians at the first try for a PSNR."""

SLOPE = 6.0
"""Usual gain of merged scenes for each e-fold of the count, dB."""


def find_count(
    measure: Callable[[int], float],
    target: float,
    at_least: bool,
    first: int,
    most: int,
    slope: float,
    tolerance: float,
    tries: float = math.inf,
) -> int | None:
    """Search for nearly the smallest count whose measure reaches the target, or nearly the largest whose measure does
    not exceed it: the best one tried; None if all counts miss it.

    Args:
        measure: from a count to a number that rises with it. It is called once for each count tried.
        target: the number to reach, or not to exceed.
        at_least: whether the measure has to reach the target; if not, it must not exceed it.
        first: the first count tried.
        most: largest count.
        slope: usual rise of the measure for each e-fold of the count.
        tolerance: distance from the target at which a count that meets it is good enough. So is one within 5 % of a
            count that misses it.
        tries: largest number of counts tried, once one has met the target.

    Example:
        >>> found = find_count(lambda count: count / 10, 42.0, True, first=1000, most=1000, slope=42.0, tolerance=1.0)
        >>> found in range(420, 442)
        True
    """
    aimed = target + (0.5 if at_least else -0.5) * tolerance
    low, high = 0, most + 1  # counts below the target, and at or above it; out of bounds until measured
    values: dict[int, float] = {}
    best: int | None = None
    count = min(max(first, 1), most)
    while True:
        value = values[count] = measure(count)
        below = value < target if at_least else value <= target
        low, high = (count, high) if below else (low, count)
        if below != at_least:
            best = count
        good_enough = best == count and abs(value - target) <= tolerance
        close = best is not None and high <= max(low, 1) * 1.05
        if good_enough or close or high - low <= 1 or (best is not None and len(values) >= tries):
            return best
        guess = _guess(values, aimed, slope)
        if low in values and high in values:  # apart from both, so that each try narrows the interval
            guess = min(low * (high / low) ** 0.85, max(low * (high / low) ** 0.15, guess))
        elif guess * 1.05 > most and most not in values:
            guess = most
        count = min(high - 1, max(low + 1, round(guess)))


def find_size(bytes_of: Callable[[int], float], limit: float, first: int, most: int) -> int | None:
    """Search for nearly the largest count, at most ``most``, whose file has at most ``limit`` bytes; None if there is
    none. Each try makes a scene, so tries are few, and 95 % of the limit are good enough."""

    def measure(count: int) -> float:
        return math.log(bytes_of(count))

    return find_count(measure, math.log(max(limit, 1)), False, first, most, 1.0, -math.log(0.95), tries=4)


def _guess(values: dict[int, float], aimed: float, slope: float) -> float:
    """The count where the line through the two measured counts nearest to ``aimed`` reaches it; with one count, or if
    the measure falls between them, a line of the usual slope. It is at most 16 times as far as the nearest."""
    nearest = sorted((count for count in values if math.isfinite(values[count])), key=lambda n: abs(values[n] - aimed))
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


@dataclass(frozen=True, eq=False)
class FoundQuality:
    """The smallest scene found that reaches a PSNR."""

    scene: Gaussians
    psnr: float
    """PSNR of ``scene`` over the pixels that the dense scene covers, dB; inf if nothing differs."""
    worst: float
    """PSNR of the worst view, dB."""
    tried: dict[int, float]
    """PSNR in dB by count, for every count tried."""


@dataclass(frozen=True)
class FileLimit:
    """A limit of the size of a compressed file, and how far the numbers of its scene are rounded to meet it."""

    kind: Format
    """A format with ``encode``."""
    most: float
    """Bytes; inf for a rounding without a limit."""
    rounding: float | None = None
    """That of :func:`rounding_for` for a scene of this quality; None for none, as long as the file meets the limit."""

    def bytes_of(self, scene: Gaussians) -> int:
        """Bytes of a scene's file, without unusable Gaussians."""
        assert self.kind.encode is not None
        return len(self.kind.encode(_as_written(scene), silent))

    def rounded(self, scene: Gaussians) -> Gaussians:
        """A scene rounded so that its file meets the limit, on its device: coarser if the file is too large, finer if
        there is room. If no rounding that is tried meets it, the last is returned."""
        if self.kind.rounded is None:
            return scene
        written, rounding = _as_written(scene), self.rounding
        if rounding is None:
            if self.most == math.inf or self.bytes_of(written) <= self.most:
                return scene
            rounding = rounding_for(math.inf, scene.sh_degree)
        best = tried = self.kind.rounded(written, rounding)
        if self.most == math.inf:
            return best.to(scene.device)
        steps, fits, exceeds = 0.0, -math.inf, math.inf  # steps finer: those tried, the most that fit, the next
        for number in range(6):
            tried = self.kind.rounded(written, rounding * 2 ** (-0.5 * steps)) if number else tried
            room = math.log(self.most / self.bytes_of(tried))
            if room >= 0:
                best, fits = tried, steps
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


@dataclass(frozen=True, eq=False)
class FoundSize:
    """The largest scene found whose file fits a limit."""

    scene: Gaussians
    """The scene before its numbers are rounded."""
    limit: FileLimit
    """The limit, and a rounding with which the file meets it."""
    tried: dict[int, int]
    """Bytes by count, for every count tried."""


def smallest_within(
    n: int,
    make: Callable[[int], Gaussians],
    psnr_of: Callable[[Gaussians, Callable[[float], None]], tuple[float, float]],
    psnr: float,
    progress: Callable[[float], None] = lambda share: None,
) -> FoundQuality:
    """Search for the smallest scene of a method that reaches ``psnr``, dB.

    Args:
        n: number of Gaussians of the dense scene.
        make: ``make(k)`` returns k Gaussians, at most n.
        psnr_of: gives the PSNR of a scene against the dense one and that of the worst view, dB, with its own progress.
        psnr: to be reached, dB.
        progress: called with the share done.

    Returns:
        A scene that was judged and reaches ``psnr``. A smaller such scene may exist where PSNR does not always rise
        with the count.

    Raises:
        BudgetError: if ``psnr`` is not a positive number, or not even n Gaussians reach it.
    """
    if not 0 < psnr < math.inf:
        raise BudgetError(f"the wanted PSNR is {psnr} dB; expected a positive number, such as 35")
    tried: dict[int, float] = {}
    best: FoundQuality | None = None

    def measure(count: int) -> float:
        nonlocal best
        scene, before = make(count), len(tried)
        tried[count], worst = psnr_of(scene, lambda share: progress(share_done(before + share)))
        if tried[count] >= psnr:
            best = FoundQuality(scene, tried[count], worst, tried)
        return tried[count]

    first = max(1, round(FIRST_SHARE * n))
    find_count(measure, psnr, at_least=True, first=first, most=n, slope=SLOPE, tolerance=0.1)
    if best is None:
        raise BudgetError(f"all {n} Gaussians reach {tried[n]:.1f} dB, not {psnr:g} dB; ask for less")
    return best


def largest_within(
    full: Gaussians,
    make: Callable[[int], Gaussians],
    limit: FileLimit,
    progress: Callable[[float], None],
    psnr_of: Callable[[Gaussians], float] | None = None,
) -> FoundSize:
    """Search for the largest scene of a method whose file meets a limit. The numbers of each scene are rounded by its
    PSNR, unless all Gaussians fit without.

    Args:
        full: the largest scene.
        make: ``make(n)`` returns n Gaussians, fewer than ``full`` has.
        limit: of the file, without rounding.
        progress: called with the share done.
        psnr_of: gives the PSNR of a scene, dB; None where there are no views: it is then taken to be 30 dB.

    Raises:
        BudgetError: if not even one Gaussian fits.
    """
    n = len(full)
    tried: dict[int, int] = {}
    best: FoundSize | None = None

    def measure(count: int) -> float:
        nonlocal best
        scene = full if count == n else make(count)
        written, found = _as_written(scene), limit
        if limit.kind.rounded is not None:
            psnr = few_psnr(psnr_of(scene) if psnr_of else 30.0, count / n)
            rounding = rounding_for(psnr, full.sh_degree)
            written, found = limit.kind.rounded(written, rounding), replace(limit, rounding=rounding)
        tried[count] = limit.bytes_of(written)
        if tried[count] <= limit.most:
            best = FoundSize(scene, found, tried)
            if count == n and found.rounding and limit.bytes_of(full) <= limit.most:
                best = FoundSize(full, limit, tried)
        progress(share_done(len(tried)))
        return tried[count]

    find_size(measure, limit.most, round(limit.most / 15), n)  # few Gaussians take less than 15 bytes each
    if best is None:
        raise BudgetError(
            f"keep is {limit.most / 1e6:g}MB{limit.kind.suffix}, too small for one Gaussian; expected at least "
            f"{tried[1] / 1e6:g}MB"
        )
    return best


def few_psnr(psnr: float, kept: float) -> float:
    """PSNR by which the numbers of a scene are rounded that has a PSNR, dB, with a share ``kept`` of the Gaussians.

    The squared error of merging is taken as A (kept^-p - 1): it falls by ``SLOPE`` for each e-fold of a small
    count, and to 0 for all Gaussians. A Gaussian more gains the more, the nearer to all they are, so that rounding may
    cost more: at the best division of bytes, its error is a share of A kept^-p, which few Gaussians have.
    """
    return psnr + 10 * math.log10(1 - kept ** (SLOPE * math.log(10) / 10)) if kept < 1 else psnr


def needed_sh_degree(dense: Gaussians, views: Views, psnr: float = 40.0) -> tuple[int, float]:
    """The lowest SH degree whose renders reach ``psnr`` (dB) against those of the whole scene, and the PSNR reached. An
    independent error of 40 dB lowers the PSNR of an ``auto`` budget of 35 dB by 1.2 dB."""
    reference = DenseReference(dense, views)
    for degree in range(dense.sh_degree):
        overall, _ = reference.psnr(cut_sh(dense, degree))
        if overall >= psnr:
            return degree, overall
    return dense.sh_degree, math.inf
