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

from pointsplat_ns.compression.requests import PruneRequest
from pointsplat_ns.errors import BudgetError, DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.rounding import rounding_for
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.looking.sampling import Sampler
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.pruning import (
    Megabytes,
    WithinPsnr,
    check_size,
    cut_sh,
    energy_lost,
    need_usable,
    prune,
    score_of,
    select,
)
from pointsplat_ns.pruning.merging import Merger
from pointsplat_ns.system.progress import Progress, silent
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
    views: Views | None = None
    """The views that merging rendered; None if it rendered none, or for another method."""
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
    if len(dense) == 0:
        raise BudgetError(f"keep is {request.keep} but the scene holds no Gaussians; expected at least one")
    need_usable(dense)
    views = views or ViewSource(dense)
    notes: list[str] = []
    rendered: list[Views] = []  # the views of each scene that was merged
    full = _with_sh(dense, request.sh, views, progress, notes)
    count = request.count_of(len(full), full.sh_degree, full.traits)
    start, cleaning, limit = full, None, None
    if request.clean:
        from pointsplat_ns.compression.cleaning import clean_scene

        cleaning = clean_scene(dense, count or 1, views, progress)
        start = cleaning.apply(full, count or 1)
        notes += cleaning.notes
    report = functools.partial(progress, f"by {request.by}")
    if count is not None:
        method_views, weight = _views_of_method(request, views), request.opacity_weight
        scene = prune(start, count, request.by, method_views, weight, report, rendered.append)
    else:
        make = _pruner(start, request, views, report, rendered)
        if cleaning is not None:
            make = _refilling(make, cleaning, full, len(start))
        searching = functools.partial(progress, "trying counts")
        if isinstance(request.budget, Megabytes):
            scene, limit = _for_size(dense, start, make, request.budget, views, searching, notes)
        else:
            scene, limit = _for_psnr(dense, make, request.budget, views, searching, notes)
    if views.origin:
        notes.insert(0, views.text)
    if limit is not None and rounding:
        scene = limit.rounded(scene)
    return Pruned(scene, tuple(notes), rendered[-1] if rendered else None, limit)


def _with_sh(dense: Gaussians, sh: str, views: ViewSource, progress: Progress, notes: list[str]) -> Gaussians:
    """The scene with the SH bands that ``sh`` keeps; adds a line to ``notes``."""
    if sh == "all":
        return dense
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
        notes.append(f"SH degree {dense.sh_degree} kept")
        return dense
    lost = 100 * energy_lost(dense, degree)
    cut = f"SH degree {dense.sh_degree} cut to {degree}"
    notes.append(f"{cut}: {lost:.0f} % of what SH add to colours is lost{reached}")
    return cut_sh(dense, degree)


def _views_of_method(request: PruneRequest, views: ViewSource) -> Views | Sampler | Callable[[], Views] | None:
    """The views that a method needs: known ones for merging, or the sampler of the scene."""
    if request.method.needs_views:
        return functools.partial(views.scored, VIEW_COUNTS.scored)
    return views.for_merging() if request.method.score is None else None


def _pruner(
    scene: Gaussians,
    request: PruneRequest,
    views: ViewSource,
    progress: Callable[[float], None],
    rendered: list[Views],
) -> Callable[[int], Gaussians]:
    """A function from a count to a scene of that many Gaussians. Scores, and the rounds of merging that counts share,
    are computed once. The views that merging rendered are added to ``rendered``."""
    method = request.method
    if method.score is None:
        merger = Merger(scene, views.for_merging())

        def made(count: int) -> Gaussians:
            merged = merger.merged(count)
            rendered.extend([] if merged.views is None else [merged.views])
            return merged.scene

        return made
    progress(0.0)
    scored = functools.partial(views.scored, VIEW_COUNTS.scored)
    scores = score_of(scene, method, scored, request.opacity_weight, progress)
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
    notes: list[str],
) -> tuple[Gaussians, FileLimit | None]:
    """The smallest scene with a PSNR against ``dense`` and, if a format rounds its numbers, the limit of its file: the
    scene has the PSNR when it is rounded. ``make`` gives the scene of a count. Adds a line to ``notes``."""
    from pointsplat_ns.compression.budget_search import FileLimit, smallest_within

    assert isinstance(budget, WithinPsnr)
    compared, kind = views.compared(), format_to_write(budget.suffix)
    limit = None if kind.rounded is None else FileLimit(kind, math.inf, rounding_for(budget.value, dense.sh_degree))
    whole: dict[int, Gaussians] = {}  # by count, where the scenes that are compared are rounded

    def made(count: int) -> Gaussians:
        scene = make(count)
        if limit is None:
            return scene
        whole[count] = scene
        return limit.rounded(scene)

    reached = smallest_within(dense, made, compared, budget.value, progress)
    notes.append(
        f"{len(reached.tried)} sizes tried: {reached.psnr:.1f} dB PSNR against the dense scene, "
        f"{reached.worst:.1f} dB in the worst of {len(compared)} views"
    )
    return whole.get(reached.count, reached.scene), limit


def _for_size(
    dense: Gaussians,
    start: Gaussians,
    make: Callable[[int], Gaussians],
    budget: Megabytes,
    views: ViewSource,
    progress: Callable[[float], None],
    notes: list[str],
) -> tuple[Gaussians, FileLimit]:
    """The largest scene whose compressed file has a size, before rounding, and the rounding; ``start`` is the largest
    scene allowed, ``make`` gives the scene of a count. Adds a line to ``notes``."""
    from pointsplat_ns.compression.budget_search import FileLimit, largest_within

    limit = FileLimit(format_to_write(budget.suffix), check_size(budget, len(dense)))
    try:
        reference = DenseReference(dense, views.compared())
        found = largest_within(start, make, limit, progress, lambda scene: reference.psnr(scene)[0])
    except DataError:  # no views
        found = largest_within(start, make, limit, progress)
    notes.append(f"{len(found.tried)} sizes tried for {bytes_text(limit.most)} as {limit.kind.name}")
    return found.scene, found.limit
