"""The smallest scene whose renders stay close enough to the dense scene's own. No photos are needed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

from pointsplat_ns.compression.closeness import DenseReference
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.sh_bands import cut_sh
from pointsplat_ns.views import Views

SH_PSNR = 40.0
"""PSNR in dB that renders without some SH bands must reach against renders with all bands. An independent error of this
size lowers the PSNR of an ``auto`` budget of 35 dB by 1.2 dB."""

PRECISION = 1.05
"""The search stops when the count is at most this factor above a count that failed."""


@dataclass(frozen=True, eq=False)
class FoundBudget:
    """The result of the search."""

    scene: Gaussians
    psnr: float
    """PSNR of ``scene`` over all pixels of all views, dB; inf if nothing differs."""
    worst: float
    """PSNR of the worst view, dB."""
    tried: dict[int, float] = field(default_factory=dict)
    """PSNR in dB by count, for every count tried."""


def smallest_within(
    dense: Gaussians,
    make: Callable[[int], Gaussians],
    views: Views,
    psnr: float,
    progress: Callable[[float], None] | None = None,
) -> FoundBudget:
    """Search for the smallest scene of a method whose renders reach ``psnr`` against those of the dense scene.

    The PSNR is that of the mean squared error over all pixels of all views, so bad views count more. The count is
    searched for between 1 and N. With one count that fails and one that suffices, the next one is found by linear
    interpolation of the PSNR over the logarithm of the count, which is nearly a straight line in practice. The result
    has been rendered and reaches ``psnr``. If quality does not always rise with the count, a smaller one may exist.

    Args:
        dense: N Gaussians.
        make: from a count K to a scene of K Gaussians.
        views: views that renders are compared in.
        psnr: PSNR to reach, dB.
        progress: called with the share done, in [0, 1].

    Raises:
        BudgetError: if ``psnr`` is not a positive number, if there is no view, or if not even all N Gaussians reach it.
    """
    if not 0 < psnr < math.inf:
        raise BudgetError(f"the wanted PSNR is {psnr} dB; expected a positive number, such as 35")
    if len(views) == 0:
        raise BudgetError("no view to compare renders from; expected at least one pose")
    n = len(dense)
    reference = DenseReference(dense, views)
    tried: dict[int, float] = {}

    def attempt(count: int) -> FoundBudget:
        scene = make(count)
        overall, worst = reference.psnr(scene)
        tried[count] = overall
        return FoundBudget(scene, overall, worst, tried)

    low, high = 0, n  # low fails, high is good enough or not yet tried
    best: FoundBudget | None = None
    guess = max(1, round(0.3 * n))
    widest = math.log(max(n, 2))
    while True:
        trial = attempt(guess)
        if trial.psnr >= psnr:
            high, best = guess, trial
        else:
            low = guess
        if progress is not None:
            progress(1 - max(0.0, math.log(high / max(low, 1)) - math.log(PRECISION)) / widest)
        if low == n:
            raise BudgetError(f"all {n} Gaussians reach {trial.psnr:.1f} dB, not {psnr:g} dB; ask for less")
        if best is None:
            guess = min(n, 2 * guess)
        elif high <= max(low, 0) * PRECISION or high - low <= 1:
            return best
        else:
            guess = _next_guess(low, high, tried, psnr)


def _next_guess(low: int, high: int, tried: dict[int, float], psnr: float) -> int:
    """A count strictly between ``low``, which fails, and ``high``, which does not."""
    below, above = math.log(max(low, 0.5)), math.log(high)
    share = 0.5
    if low in tried and math.isfinite(tried[high]) and math.isfinite(tried[low]):
        share = (psnr - tried[low]) / (tried[high] - tried[low])
        share = min(0.85, max(0.15, share + 0.03))  # a little more, so that the last try is likely to suffice
    elif low == 0:
        share = 1 - math.log(4) / max(above - below, math.log(4))  # a quarter of the count that suffices
    return min(high - 1, max(low + 1, round(math.exp(below + share * (above - below)))))


def needed_sh_degree(dense: Gaussians, views: Views, psnr: float = SH_PSNR) -> tuple[int, float]:
    """The lowest SH degree whose renders reach ``psnr`` (dB) against those of the whole scene, and the PSNR reached."""
    reference = DenseReference(dense, views)
    for degree in range(dense.sh_degree):
        overall, _ = reference.psnr(cut_sh(dense, degree))
        if overall >= psnr:
            return degree, overall
    return dense.sh_degree, math.inf
