"""Pruning with all options: first cleaning and SH bands, then the count by any method and budget, then fine-tuning.

Views are only looked up or sampled if they are needed: for a budget in dB, ``auto`` SH, a method that scores by views,
cleaning that removes anything, or fine-tuning.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

from pointsplat_ns.compression.budget_search import SH_PSNR, largest_within, needed_sh_degree, smallest_within
from pointsplat_ns.compression.cleaning import Cleaning, clean_scene
from pointsplat_ns.compression.fine_tune import fine_tune
from pointsplat_ns.errors import BudgetError, PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.looking.view_source import MERGED_FROM, ViewSource
from pointsplat_ns.pruning import (
    Keep,
    Megabytes,
    WithinPsnr,
    check_size,
    cut_sh,
    energy_lost,
    found_by_trying,
    method_named,
    need_usable,
    parse_keep,
    prune,
    resolve_keep,
    score_of,
    select,
)
from pointsplat_ns.pruning.methods import check_opacity_weight
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.views import Views

SCORED_VIEWS = 40
"""Maximum number of views for fine-tuning and for methods that score by views. Datasets may have thousands."""

SH_CHOICES = ("all", "auto", "0", "1", "2", "3")
"""Values of the option ``sh``."""


@dataclass(frozen=True, eq=False)
class Pruned:
    """A smaller scene, with notes on how it was made."""

    scene: Gaussians
    notes: tuple[str, ...]
    """Lines of text: SH bands dropped, PSNR reached, where views came from."""


def prune_scene(
    dense: Gaussians,
    keep: Keep | str,
    by: str = "merge",
    sh: str = "all",
    opacity_weight: float | None = None,
    views: ViewSource | None = None,
    fine_tune_steps: int = 0,
    progress: Progress = silent,
    clean: bool = False,
) -> Pruned:
    """Make a scene smaller.

    Args:
        dense: N Gaussians.
        keep: ratio, count, size, or the PSNR that renders must reach against those of ``dense``.
        by: one of :data:`~pointsplat_ns.pruning.METHODS`.
        sh: "all" keeps the SH bands, a digit cuts them to that degree, "auto" to the lowest degree whose renders
            reach :data:`~pointsplat_ns.compression.budget_search.SH_PSNR` against those of ``dense``.
        opacity_weight: lambda of the methods that weigh opacity; by default the paper's.
        views: source of views, if they are needed; by default poses sampled in free space.
        fine_tune_steps: steps of optimising the result against renders of ``dense``.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].
        clean: first remove what no picture needs, see :mod:`~pointsplat_ns.compression.cleaning`. ``keep`` still refers
            to ``dense``, and the result has exactly as many Gaussians.

    Raises:
        BudgetError: if the budget cannot be met.
        SceneError: if no Gaussian of the scene can be drawn.
        DataError: if views are needed and there are none.
        PointSplatError: if there is no such method, or an option does not fit it.
    """
    keep = check_options(keep, by, sh, opacity_weight, fine_tune_steps)
    if isinstance(keep, Megabytes):
        check_size(keep, len(dense))
    if not found_by_trying(keep):
        resolve_keep(len(dense), keep, _lowest_degree(dense, sh))
    need_usable(dense)
    views = views or ViewSource(dense)
    notes: list[str] = []
    full = _with_sh(dense, sh, views, progress, notes)
    count = 1 if found_by_trying(keep) else resolve_keep(len(full), keep, full.sh_degree)
    cleaning = clean_scene(dense, count, views, progress) if clean else None
    start = full if cleaning is None else cleaning.apply(full, count)
    notes += () if cleaning is None else cleaning.notes
    report = functools.partial(progress, f"by {by}")
    if found_by_trying(keep):
        make = _pruner(start, by, views, opacity_weight, report)
        if cleaning is not None:
            make = _refilling(make, cleaning, full, len(start))
    if isinstance(keep, WithinPsnr):
        compared = views.compared()
        search = smallest_within(dense, make, compared, keep.value, functools.partial(progress, "trying counts"))
        scene = search.scene
        notes.append(
            f"renders reach {search.psnr:.1f} dB against the dense scene's, {search.worst:.1f} dB in the worst of "
            f"{len(compared)} views; {len(search.tried)} counts tried"
        )
    elif isinstance(keep, Megabytes) and found_by_trying(keep):
        kind, limit = format_to_write(keep.suffix), check_size(keep, len(dense))
        found = largest_within(start, make, kind, limit, functools.partial(progress, "trying counts"))
        scene = found.scene
        notes.append(f"as {kind.name} {found.size / 1e6:.2f} MB; {len(found.tried)} counts tried")
    else:
        seen_from = _seen_from(by, views)
        scene = prune(start, count, by, seen_from, opacity_weight, report, notes.append, views.resolution)
    if fine_tune_steps:
        tuned = views.scored(SCORED_VIEWS)
        scene = fine_tune(scene, tuned, dense, fine_tune_steps, progress=functools.partial(progress, "fine-tuning"))
        notes.append(f"fine-tuned {fine_tune_steps} steps against the dense scene's renders in {len(tuned)} views")
    return Pruned(scene, (*notes, views.origin) if views.origin else tuple(notes))


def check_options(
    keep: Keep | str, by: str, sh: str = "all", opacity_weight: float | None = None, fine_tune_steps: int = 0
) -> Keep:
    """Check the options of :func:`prune_scene` that do not depend on the scene, before a scene is read.

    Returns:
        ``keep``, parsed if it is text.

    Raises:
        BudgetError: if ``keep`` is not a budget.
        PointSplatError: if there is no such method, or an option does not fit it.
    """
    check_opacity_weight(method_named(by), opacity_weight)
    if sh not in SH_CHOICES:
        raise PointSplatError(f"sh is {sh!r}; expected all, auto or a degree from 0 to 3")
    if fine_tune_steps < 0:
        raise PointSplatError(f"{fine_tune_steps} steps of fine-tuning; expected 0 for none, or more")
    keep = parse_keep(keep) if isinstance(keep, str) else keep
    if isinstance(keep, WithinPsnr) and not 0 < keep.value < math.inf:
        raise BudgetError(f"the wanted PSNR is {keep.value} dB; expected a positive number, such as 35")
    return keep


def _lowest_degree(dense: Gaussians, sh: str) -> int:
    """The lowest SH degree that the result may have, on which the number of Gaussians that fit a file size depends."""
    return dense.sh_degree if sh == "all" else 0 if sh == "auto" else min(int(sh), dense.sh_degree)


def _pruner(
    scene: Gaussians,
    by: str,
    views: ViewSource,
    opacity_weight: float | None,
    progress: Callable[[float], None],
) -> Callable[[int], Gaussians]:
    """A function from a count to a scene of that many Gaussians. Scores are computed once, for all counts."""
    method = method_named(by)
    if method.score is None:
        known = views.known(MERGED_FROM)
        return lambda count: prune(scene, count, by, known, resolution=views.resolution)
    progress(0.0)
    scores = score_of(scene, method, functools.partial(views.scored, SCORED_VIEWS), opacity_weight, progress)
    return lambda count: scene[select(scores, count)]


def _refilling(
    make: Callable[[int], Gaussians], cleaning: Cleaning, full: Gaussians, most: int
) -> Callable[[int], Gaussians]:
    """``make`` for counts above ``most``, the number of Gaussians in the cleaned scene, too: it gets junk back then."""
    return lambda count: make(count) if count <= most else cleaning.apply(full, count)


def _seen_from(by: str, views: ViewSource) -> Views | Callable[[], Views] | None:
    """The views that a method sees the scene from: only known ones for merging, which needs none."""
    method = method_named(by)
    if method.needs_views:
        return functools.partial(views.scored, SCORED_VIEWS)
    return views.known(MERGED_FROM) if method.score is None else None


def _with_sh(dense: Gaussians, sh: str, views: ViewSource, progress: Progress, notes: list[str]) -> Gaussians:
    """The scene with the SH bands that ``sh`` keeps; adds a line to ``notes``."""
    if sh == "all":
        return dense
    reached = ""
    if sh == "auto":
        progress("comparing SH degrees", 0.0)
        degree, psnr = needed_sh_degree(dense, views.compared(), SH_PSNR)
        if math.isfinite(psnr):
            reached = f"; renders reach {psnr:.1f} dB against all bands"
    else:
        degree = int(sh)
    if degree >= dense.sh_degree:
        notes.append(f"SH degree {dense.sh_degree} kept, no band dropped")
        return dense
    lost = 100 * energy_lost(dense, degree)
    notes.append(f"SH degree {dense.sh_degree} cut to {degree}: {lost:.0f} % of the directional energy lost{reached}")
    return cut_sh(dense, degree)
