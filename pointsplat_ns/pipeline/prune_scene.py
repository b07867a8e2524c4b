"""Prunes a scene with all options: SH bands and cleaning first, then a method and a budget.

Views are read or sampled only if needed: by a budget in dB, ``auto`` SH, a method that scores in
views, or cleaning that removes a Gaussian.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

from pointsplat_ns.errors import DataError
from pointsplat_ns.pipeline.budget_search import (
    FileLimit,
    largest_within,
    share_done,
    smallest_within,
)
from pointsplat_ns.pipeline.cleaning import Cleaning, clean_scene
from pointsplat_ns.pipeline.options import ReductionOptions
from pointsplat_ns.pipeline.quality import Judge, through_file
from pointsplat_ns.pipeline.report import PsnrSearch, ShCut, SizeSearch
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.pruning import (
    Megabytes,
    WithinPsnr,
    cut_sh,
    energy_lost,
    need_usable,
    score_of,
    select,
)
from pointsplat_ns.pruning.merging import Merger, merge
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.formats import Format
from pointsplat_ns.scene.formats.rounding import rounding_for
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.progress import Progress, silent


@dataclass(frozen=True, eq=False)
class Pruned:
    """A pruned scene, and how it was made."""

    scene: Gaussians
    sh: ShCut | None = None
    """Cut SH bands; None if all bands are requested."""
    cleaning: Cleaning | None = None
    """Result of cleaning; None if not requested."""
    search: PsnrSearch | SizeSearch | None = None
    """Search for the count; None if the budget determines the count."""
    limit: FileLimit | None = None
    """Limit of a compressed file, with the rounding that meets it; None for other budgets."""


def prune_scene(
    dense: Gaussians,
    options: ReductionOptions,
    views: ViewProvider | None = None,
    progress: Progress = silent,
    rounding: bool = True,
) -> Pruned:
    """Prune a scene, by default with sampled views.

    With the size of a compressed file as the budget, values are rounded unless ``rounding`` is
    False. Raises BudgetError if the budget cannot be met, SceneError if no Gaussian can be drawn,
    and DataError if views are needed and there are none."""
    ReductionOptions.check(options)
    need_usable(dense)
    views = views or ViewProvider(dense)
    full, sh_cut = _with_sh(dense, options.sh, views, progress)
    count = options.count_of(len(full), full.sh_degree, full.traits)
    start = full
    cleaning = None
    limit = None
    search: PsnrSearch | SizeSearch | None = None
    if options.clean:
        cleaning = clean_scene(dense, count or 1, views, progress)
        start = cleaning.apply(full, count or 1)
    scored = functools.partial(views.scored, VIEW_COUNTS.scored)
    merging = options.method.score is None
    report = functools.partial(progress, "merging" if merging else f"scoring by {options.by}")
    if count is not None and merging:
        scene = merge(start, count, report, views.for_merging()).scene
    elif count is not None:
        scores = score_of(start, options.method, scored, options.opacity_weight, report)
        scene = start[select(scores, count)]
    else:
        if merging:
            merger = Merger(start, views.for_merging())
        else:
            report(0.0)
            scores = score_of(start, options.method, scored, options.opacity_weight, report)

        def make(count: int) -> Gaussians:
            if cleaning is not None and count > len(start):
                return cleaning.apply(full, count)  # with the most opaque junk
            return merger.merged(count).scene if merging else start[select(scores, count)]

        searching = functools.partial(progress, "trying counts")
        budget = options.budget
        if isinstance(budget, Megabytes):
            target = FileLimit(options.format_of(budget.suffix), budget.bytes)
            scene, limit, search = _for_size(dense, start, make, target, views, searching)
        else:
            assert isinstance(budget, WithinPsnr)
            kind = options.format_of(budget.suffix)
            scene, limit, search = _for_psnr(dense, make, budget.value, kind, views, searching)
    if limit is not None and rounding:
        scene = limit.rounded(scene)
    return Pruned(scene=scene, sh=sh_cut, cleaning=cleaning, search=search, limit=limit)


def _with_sh(
    dense: Gaussians, sh: str, views: ViewProvider, progress: Progress
) -> tuple[Gaussians, ShCut | None]:
    """The scene with the SH bands of ``sh``, and the cut; None if all bands are requested."""
    if sh == "all":
        return dense, None
    reached = None
    if sh == "auto":
        progress("comparing SH degrees", 0.0)
        reference = DenseReference(dense, views.compared())
        psnrs = (
            (degree, reference.psnr(cut_sh(dense, degree))[0]) for degree in range(dense.sh_degree)
        )
        # An independent error of 40 dB lowers the PSNR of an ``auto`` budget of 35 dB by 1.2 dB.
        degree, psnr = next(
            (pair for pair in psnrs if pair[1] >= 40.0), (dense.sh_degree, math.inf)
        )
        reached = psnr if math.isfinite(psnr) else None
    else:
        degree = int(sh)
    if degree >= dense.sh_degree:
        return dense, ShCut(before=dense.sh_degree, after=dense.sh_degree)
    cut = ShCut(before=dense.sh_degree, after=degree, lost=energy_lost(dense, degree), psnr=reached)
    return cut_sh(dense, degree), cut


def _for_psnr(
    dense: Gaussians,
    make: Callable[[int], Gaussians],
    wanted: float,
    kind: Format,
    views: ViewProvider,
    progress: Callable[[float], None],
) -> tuple[Gaussians, FileLimit | None, PsnrSearch]:
    """The smallest scene that reaches the ``wanted`` PSNR against ``dense``, dB, the limit of its
    file, and the search.

    For a format that rounds, the rounded scene reaches the PSNR; for others the limit is None.
    ``make(n)`` returns n Gaussians."""
    judge = Judge(dense, views)
    limit = (
        None
        if kind.rounded is None
        else FileLimit(kind, math.inf, rounding_for(wanted, dense.sh_degree))
    )
    numbers = itertools.count()

    def measure(count: int) -> tuple[float, tuple[Gaussians, float, float]]:
        scene = make(count)
        before = next(numbers)
        _, written = through_file(scene if limit is None else limit.rounded(scene), kind)
        psnr, worst = judge.psnr(written, lambda share: progress(share_done(before + share)))
        return psnr, (scene, psnr, worst)

    (scene, psnr, worst), found = smallest_within(len(dense), measure, wanted)
    search = PsnrSearch(tried=len(found.tried), psnr=psnr, worst=worst, views=len(judge.views))
    return scene, limit, search


def _for_size(
    dense: Gaussians,
    start: Gaussians,
    make: Callable[[int], Gaussians],
    limit: FileLimit,
    views: ViewProvider,
    progress: Callable[[float], None],
) -> tuple[Gaussians, FileLimit, SizeSearch]:
    """The largest scene whose compressed file meets a limit, unrounded; the limit with its
    rounding; and the search. ``start`` is the largest allowed scene, ``make(n)`` returns n
    Gaussians."""
    try:
        reference = DenseReference(dense, views.compared())
        found = largest_within(start, make, limit, progress, lambda scene: reference.psnr(scene)[0])
    except DataError:  # no views
        found = largest_within(start, make, limit, progress)
    scene, rounded, tries = found
    return scene, rounded, SizeSearch(tried=tries, bytes=limit.most, format=limit.kind.name)
