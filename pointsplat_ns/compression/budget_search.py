"""Finds the number of Gaussians for budgets without a formula: a PSNR of renders, or the size of a compressed file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from pointsplat_ns.compression.count_search import SearchSettings, find_count
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats import Format
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.pruning.sh_bands import cut_sh
from pointsplat_ns.system.progress import silent
from pointsplat_ns.views import Views


@dataclass(frozen=True)
class BudgetSettings:
    """Settings of the searches."""

    sh_psnr: float = 40.0
    """PSNR, in dB, of renders without some SH bands against renders with all bands, for ``sh="auto"``. An independent
    error of this size lowers the PSNR of an ``auto`` budget of 35 dB by 1.2 dB."""
    first_share: float = 0.3
    """Share of the Gaussians at the first try for a PSNR."""
    slope: float = 6.0
    """Usual gain of merged scenes for each e-fold of the count, dB."""
    psnr: SearchSettings = SearchSettings(tolerance=0.1)
    """Search for a PSNR in dB: it ends within 0.1 dB above the target."""
    size: SearchSettings = SearchSettings(tolerance=-math.log(0.95), tries=3)
    """Search for the logarithm of a file's size: it ends at 95 % of the limit. Each try makes a scene, so tries are
    few."""


BUDGETS = BudgetSettings()


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


@dataclass(frozen=True, eq=False)
class FoundSize:
    """The largest scene found whose file fits a limit."""

    scene: Gaussians
    size: int
    """Bytes of its file."""
    tried: dict[int, int]
    """Bytes by count, for every count tried."""


def smallest_within(
    dense: Gaussians,
    make: Callable[[int], Gaussians],
    views: Views,
    psnr: float,
    progress: Callable[[float], None] | None = None,
) -> FoundQuality:
    """Search for the smallest scene of a method whose renders reach ``psnr``, dB, against those of the dense scene in
    some views; ``make`` gives the scene of a count.

    The PSNR is that of the mean squared error of all views, so bad views count more, over the pixels that the dense
    scene covers. The result was rendered and reaches ``psnr``. A smaller such scene may exist where PSNR does not
    always rise with the count. Raises BudgetError if ``psnr`` is not a positive number, if there is no view, or if not
    even all N Gaussians reach it.
    """
    if not 0 < psnr < math.inf:
        raise BudgetError(f"the wanted PSNR is {psnr} dB; expected a positive number, such as 35")
    if len(views) == 0:
        raise BudgetError("no view to compare renders from; expected at least one pose")
    n, reference = len(dense), DenseReference(dense, views)
    tried: dict[int, float] = {}
    best: FoundQuality | None = None

    def measure(count: int) -> float:
        nonlocal best
        scene = make(count)
        tried[count], worst = reference.psnr(scene)
        if tried[count] >= psnr:
            best = FoundQuality(scene, tried[count], worst, tried)
        if progress is not None:
            progress(len(tried) / (len(tried) + 2))
        return tried[count]

    first = max(1, round(BUDGETS.first_share * n))
    find_count(measure, psnr, at_least=True, first=first, most=n, slope=BUDGETS.slope, settings=BUDGETS.psnr)
    if best is None:
        raise BudgetError(f"all {n} Gaussians reach {tried[n]:.1f} dB, not {psnr:g} dB; ask for less")
    return best


def largest_within(
    full: Gaussians,
    make: Callable[[int], Gaussians],
    kind: Format,
    limit: int,
    progress: Callable[[float], None],
) -> FoundSize:
    """Search for the largest scene of a method whose file, of a compressed format, has at most ``limit`` bytes;
    ``make`` gives the scene of a count below that of ``full``. Raises BudgetError if not even one Gaussian fits."""
    n = len(full)
    tried: dict[int, int] = {}
    best: FoundSize | None = None

    def measure(count: int) -> float:
        nonlocal best
        scene = full if count == n else make(count)
        tried[count] = _size(scene, kind)
        if tried[count] <= limit:
            best = FoundSize(scene, tried[count], tried)
        progress(len(tried) / (len(tried) + 2))
        return math.log(tried[count])

    find_count(measure, math.log(limit), at_least=False, first=n, most=n, slope=1.0, settings=BUDGETS.size)
    if best is None:
        raise BudgetError(
            f"keep is {limit / 1e6:g}MB{kind.suffix}, too small for one Gaussian; expected at least "
            f"{tried[1] / 1e6:g}MB"
        )
    return best


def _size(scene: Gaussians, kind: Format) -> int:
    """Bytes of a scene's file, without unusable Gaussians."""
    assert kind.encode is not None
    scene = scene.detach().to("cpu", torch.float32)
    return len(kind.encode(scene[scene.usable()], silent))


def needed_sh_degree(dense: Gaussians, views: Views, psnr: float = BUDGETS.sh_psnr) -> tuple[int, float]:
    """The lowest SH degree whose renders reach ``psnr`` (dB) against those of the whole scene, and the PSNR reached."""
    reference = DenseReference(dense, views)
    for degree in range(dense.sh_degree):
        overall, _ = reference.psnr(cut_sh(dense, degree))
        if overall >= psnr:
            return degree, overall
    return dense.sh_degree, math.inf
