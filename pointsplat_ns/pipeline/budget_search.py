"""Searches the count for budgets without a formula: PSNR of renders, size of a compressed file.

Both measures rise nearly linearly with the logarithm of the count. The next count is interpolated
between a count below the target and one above it, or extrapolated while all tried counts lie on one
side.
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
"""Typical gain of merged scenes per e-fold of the count, dB."""

Candidate = TypeVar("Candidate")


@dataclass(frozen=True, eq=False)
class SearchResult(Generic[Candidate]):
    """The result of a search."""

    best: Candidate | None
    """Candidate of the best count; None if all counts miss the target."""
    tried: dict[int, float]
    """Measured value of every tried count."""
    interrupted: bool
    """Whether Ctrl-C ended the search."""


def find_count(
    measure: Callable[[int], tuple[float, Candidate]],
    target: float,
    at_least: bool,
    first: int,
    most: int,
    slope: float,
    tolerance: float,
    tries: float = math.inf,
    stoppable: bool = False,
) -> SearchResult[Candidate]:
    """Search for nearly the smallest count that reaches a target, or nearly the largest that does
    not exceed it. The result is the best of the tried counts that meet the target.

    Args:
        measure: returns a value that rises with the count, and the candidate of that count. It is
            called once per tried count.
        target: value to reach, or not to exceed.
        at_least: True to reach the target; False not to exceed it.
        first: first count to try.
        most: maximum count.
        slope: typical rise of the value per e-fold of the count.
        tolerance: the search ends with a count that meets the target and is this close to it, or
            within 5 % of a count that misses it.
        tries: maximum number of tried counts, once one meets the target.
        stoppable: whether Ctrl-C ends the search with the best candidate so far, if any.

    Example:
        >>> found = find_count(lambda k: (k / 10, k), 42.0, True, first=1000, most=1000, slope=42.0, tolerance=1.0)
        >>> found.best in range(420, 442)
        True
    """
    aimed = target + (0.5 if at_least else -0.5) * tolerance
    # Largest count below the target, smallest count at or above it; out of bounds until measured.
    low = 0
    high = most + 1
    values: dict[int, float] = {}
    best: tuple[int, Candidate] | None = None
    count = min(max(first, 1), most)
    while True:
        try:
            value, candidate = measure(count)
        except KeyboardInterrupt:
            if best is None or not stoppable:
                raise
            return SearchResult(best[1], values, True)
        values[count] = value
        below = value < target if at_least else value <= target
        low, high = (count, high) if below else (low, count)
        if below != at_least:
            best = count, candidate
        good_enough = best is not None and best[0] == count and abs(value - target) <= tolerance
        close = best is not None and high <= max(low, 1) * 1.05
        if good_enough or close or high - low <= 1 or (best is not None and len(values) >= tries):
            return SearchResult(None if best is None else best[1], values, False)
        guess = _guess(values, aimed, slope)
        if low in values and high in values:
            # Away from both ends, so that each try narrows the interval.
            guess = min(low * (high / low) ** 0.85, max(low * (high / low) ** 0.15, guess))
        elif guess * 1.05 > most and most not in values:
            guess = most
        count = min(high - 1, max(low + 1, round(guess)))


def _guess(values: dict[int, float], aimed: float, slope: float) -> float:
    """Count at which the line through the two nearest measured values reaches ``aimed``.

    With one count, or where the value falls between the two, the line has the typical slope. The count differs from the nearest one by at most a factor of 16."""
    nearest = sorted(
        (count for count in values if math.isfinite(values[count])),
        key=lambda n: abs(values[n] - aimed),
    )
    if not nearest:
        return min(values) / 4
    if len(nearest) > 1:
        fewer, more = sorted(nearest[:2])
        measured = (values[more] - values[fewer]) / math.log(more / fewer)
        slope = measured if measured > 0 else slope
    step = (aimed - values[nearest[0]]) / slope
    return nearest[0] * math.exp(min(max(step, -math.log(16.0)), math.log(16.0)))


def share_done(tries: float) -> float:
    """Progress of a search after some tries, in [0, 1). A search takes about four."""
    return 1 - 0.75**tries


@dataclass(frozen=True)
class FileLimit:
    """Maximum size of a compressed file, and the rounding of its values that meets it."""

    kind: Format
    """A format with ``encode``."""
    most: float
    """Maximum size, bytes; inf for rounding without a limit."""
    rounding: float | None = None
    """Rounding step from :func:`rounding_for`; None to round only if the file exceeds the limit."""

    def bytes_of(self, scene: Gaussians) -> int:
        """Size of the scene's file without unusable Gaussians, bytes."""
        assert self.kind.encode is not None
        return len(self.kind.encode(_usable_on_cpu(scene), silent))

    def rounded(self, scene: Gaussians) -> Gaussians:
        """The scene, rounded until its file meets the limit: coarser if the file is too large,
        finer if there is room. If no tried rounding meets it, the last one is returned."""
        if self.kind.rounded is None:
            return scene
        written = _usable_on_cpu(scene)
        rounding = self.rounding
        if rounding is None:
            if self.most == math.inf or self.bytes_of(written) <= self.most:
                return scene
            rounding = rounding_for(math.inf, scene.sh_degree)
        best = tried = self.kind.rounded(written, rounding)
        if self.most == math.inf:
            return best.to(scene.device)
        # number of finer steps: current, largest that fits, smallest that exceeds
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


def _usable_on_cpu(scene: Gaussians) -> Gaussians:
    scene = scene.detach().to("cpu", torch.float32)
    return scene[scene.usable()]


def smallest_within(
    n: int,
    measure: Callable[[int], tuple[float, Candidate]],
    psnr: float,
    stoppable: bool = False,
    first: float = 0.3,
    slope: float = SLOPE,
) -> tuple[Candidate, SearchResult[Candidate]]:
    """Search for the smallest scene that reaches ``psnr``, dB. A smaller one may exist where PSNR
    does not always rise with the count.

    Args:
        n: number of Gaussians of the dense scene.
        measure: returns the PSNR against the dense scene, dB, and the candidate of a count in 1..n.
        psnr: PSNR to reach, dB, above 0.
        stoppable, slope: as for :func:`find_count`.
        first: first share of n to try.

    Returns:
        Candidate of the best count, and the search.

    Raises:
        BudgetError: if all n Gaussians miss it.
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
    """Search for the largest scene whose file meets a limit.

    The values of each scene are rounded by its PSNR, unless all Gaussians fit unrounded. Each try makes a scene, so the search stops early: at 95 % of the limit.

    Args:
        full: the largest scene.
        make: ``make(n)`` returns n Gaussians, fewer than ``full`` has.
        limit: limit of the file, without rounding.
        progress: called with the share done.
        psnr_of: returns the PSNR of a scene, dB; None without views, which assumes 30 dB.

    Returns:
        The unrounded scene, the limit with a rounding that meets it, and the number of tries.

    Raises:
        BudgetError: if one Gaussian is too large.
    """
    n = len(full)
    numbers = itertools.count(1)

    def measure(count: int) -> tuple[float, tuple[Gaussians, FileLimit]]:
        scene = full if count == n else make(count)
        written = _usable_on_cpu(scene)
        found = limit
        if limit.kind.rounded is not None:
            psnr = rounding_psnr(psnr_of(scene) if psnr_of else 30.0, count / n)
            rounding = rounding_for(psnr, full.sh_degree)
            written = limit.kind.rounded(written, rounding)
            found = replace(limit, rounding=rounding)
        size = limit.bytes_of(written)
        fits = size <= limit.most
        if fits and count == n and found.rounding and limit.bytes_of(full) <= limit.most:
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


def rounding_psnr(psnr: float, share: float) -> float:
    """PSNR that decides how far a smaller scene is rounded, dB.

    The squared error of merging is modelled as A (share^-p - 1): it falls by ``SLOPE`` per e-fold
    of a small count, and is 0 for all Gaussians. One more Gaussian gains more, the closer the count
    is to all, so coarser rounding pays off. At the best division of bytes, the error of rounding is
    a share of A share^-p, the error of a small count.

    Args:
        psnr: PSNR of the smaller scene against the dense scene, dB.
        share: share of the Gaussians that remain, in (0, 1].
    """
    return psnr + 10 * math.log10(1 - share ** (SLOPE * math.log(10) / 10)) if share < 1 else psnr
