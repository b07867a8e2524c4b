"""Pruning with all options: cleaning and SH bands first, then a method and a budget.

Views are read or sampled only where they are needed: for a budget in dB, ``auto`` SH, a method that scores by views,
or cleaning that removes a Gaussian.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from pointsplat_ns.comparing.closeness import DenseReference, views_text
from pointsplat_ns.compression.requests import PruneRequest
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.rounding import rounding_for
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.merging import Merger, merge
from pointsplat_ns.pruning import (
    Megabytes,
    WithinPsnr,
    cut_sh,
    energy_lost,
    need_usable,
    score_of,
    select,
)
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.quantities import counted
from pointsplat_ns.views import Views

if TYPE_CHECKING:
    from pointsplat_ns.compression.budget_search import FileLimit
    from pointsplat_ns.compression.cleaning import Cleaning


@dataclass(frozen=True, eq=False)
class Pruned:
    """A smaller scene, with notes."""

    scene: Gaussians
    notes: tuple[str, ...]
    """Lines of text: SH bands dropped, PSNR reached, origin of the views."""
    limit: FileLimit | None = None
    """The limit of a compressed file, and the rounding that meets it; None for another budget."""


def prune_scene(
    dense: Gaussians,
    request: PruneRequest,
    views: ViewSource | None = None,
    progress: Progress = silent,
    rounding: bool = True,
) -> Pruned:
    """Make a scene smaller, by default with sampled views. Its numbers are rounded for the size of a
    compressed file, unless ``rounding`` is False. Raises BudgetError if the budget cannot be met, SceneError if no
    Gaussian of the scene can be drawn, and DataError if views are needed and there are none."""
    need_usable(dense)
    views = views or ViewSource(dense)
    full, about_sh = _with_sh(dense, request.sh, views, progress)
    count = request.count_of(len(full), full.sh_degree, full.traits)
    start, cleaning, limit, searched = full, None, None, ""
    if request.clean:
        from pointsplat_ns.compression.cleaning import clean_scene

        cleaning = clean_scene(dense, count or 1, views, progress)
        start = cleaning.apply(full, count or 1)
    scored = functools.partial(views.scored, VIEW_COUNTS.scored)
    merging = request.method.score is None
    report = functools.partial(progress, "merging" if merging else f"scoring by {request.by}")
    if count is not None and merging:
        scene = merge(start, count, report, views.for_merging()).scene
    elif count is not None:
        scene = start[select(score_of(start, request.method, scored, request.opacity_weight, report), count)]
    else:
        merger = Merger(start, views.for_merging()) if merging else None
        make = _selector(start, request, scored, report) if merger is None else lambda k: merger.merged(k).scene
        if cleaning is not None:
            make = _refilling(make, cleaning, full, len(start))
        searching = functools.partial(progress, "trying counts")
        if isinstance(request.budget, Megabytes):
            scene, limit, searched = _for_size(dense, start, make, request.budget, views, searching)
        else:
            scene, limit, searched = _for_psnr(dense, make, request.budget, views, searching)
    if limit is not None and rounding:
        scene = limit.rounded(scene)
    about_views = views.text if views.origin else ""
    about_junk = () if cleaning is None else cleaning.notes
    notes = tuple(note for note in (about_views, about_sh, *about_junk, searched) if note)
    return Pruned(scene, notes, limit)


def _with_sh(dense: Gaussians, sh: str, views: ViewSource, progress: Progress) -> tuple[Gaussians, str]:
    """The scene with the SH bands that ``sh`` keeps, and a line on them; an empty one if it keeps all."""
    if sh == "all":
        return dense, ""
    reached = ""
    if sh == "auto":
        from pointsplat_ns.compression.budget_search import needed_sh_degree

        progress("comparing SH degrees", 0.0)
        degree, psnr = needed_sh_degree(dense, views.compared())
        if math.isfinite(psnr):
            reached = f", {psnr:.1f} dB PSNR against all bands"
    else:
        degree = int(sh)
    if degree >= dense.sh_degree:
        return dense, f"SH degree {dense.sh_degree} kept"
    lost = energy_lost(dense, degree)
    cut = f"SH degree {dense.sh_degree} cut to {degree}"
    return cut_sh(dense, degree), f"{cut}: colours change {lost:.0%} less with the view{reached}"


def _selector(
    scene: Gaussians, request: PruneRequest, views: Callable[[], Views], progress: Callable[[float], None]
) -> Callable[[int], Gaussians]:
    """A function from a count to so many Gaussians of the highest scores, which are computed once."""
    progress(0.0)
    scores = score_of(scene, request.method, views, request.opacity_weight, progress)
    return lambda count: scene[select(scores, count)]


def _refilling(
    make: Callable[[int], Gaussians], cleaning: Cleaning, full: Gaussians, most: int
) -> Callable[[int], Gaussians]:
    """``make`` extended to counts above ``most``, the number of Gaussians in the cleaned scene. Such a scene gets the
    most opaque of its junk back."""
    return lambda count: make(count) if count <= most else cleaning.apply(full, count)


def _for_psnr(
    dense: Gaussians,
    make: Callable[[int], Gaussians],
    budget: object,
    views: ViewSource,
    progress: Callable[[float], None],
) -> tuple[Gaussians, FileLimit | None, str]:
    """The smallest scene with a PSNR against ``dense``; if a format rounds its numbers, the limit of its file: the
    scene has the PSNR when it is rounded; and a line on the search. ``make(n)`` returns n Gaussians."""
    from pointsplat_ns.compression.budget_search import FileLimit, smallest_within
    from pointsplat_ns.compression.quality import Judge, decibels, through_file

    assert isinstance(budget, WithinPsnr)
    judge, kind = Judge(dense, views), format_to_write(budget.suffix)
    limit = None if kind.rounded is None else FileLimit(kind, math.inf, rounding_for(budget.value, dense.sh_degree))

    def psnr_of(scene: Gaussians, progress: Callable[[float], None]) -> tuple[float, float]:
        rounded = scene if limit is None else limit.rounded(scene)
        return judge.psnr(through_file(rounded, budget.suffix)[1], progress)

    reached = smallest_within(len(dense), make, psnr_of, budget.value, progress)
    note = (
        f"{counted(len(reached.tried), 'size')} tried: {decibels(reached.psnr)} against the dense scene, "
        f"{decibels(reached.worst)} in the worst of {views_text(len(judge.views))}"
    )
    return reached.scene, limit, note


def _for_size(
    dense: Gaussians,
    start: Gaussians,
    make: Callable[[int], Gaussians],
    budget: Megabytes,
    views: ViewSource,
    progress: Callable[[float], None],
) -> tuple[Gaussians, FileLimit, str]:
    """The largest scene whose compressed file has a size, before rounding, the rounding, and a line on the search;
    ``start`` is the largest scene allowed, ``make(n)`` returns n Gaussians."""
    from pointsplat_ns.compression.budget_search import FileLimit, largest_within

    limit = FileLimit(format_to_write(budget.suffix), budget.bytes)
    try:
        reference = DenseReference(dense, views.compared())
        found = largest_within(start, make, limit, progress, lambda scene: reference.psnr(scene)[0])
    except DataError:  # no views
        found = largest_within(start, make, limit, progress)
    note = f"{counted(len(found.tried), 'size')} tried for {bytes_text(limit.most)} as {limit.kind.name}"
    return found.scene, found.limit, note
