"""Compacts a scene in stages: prune, refine, repair, and round for a file of limited size. Refinement and repair are
accepted by comparing renders with those of the dense scene."""

from __future__ import annotations

import functools
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pointsplat_ns.compression.acceptance import Comparison, Reason, accept_change
from pointsplat_ns.compression.budget_search import FileLimit
from pointsplat_ns.compression.photo_repair import PhotoRepaired, Photos, photo_repair
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.repair import repair
from pointsplat_ns.compression.requests import CompactRequest, PhotoBudget
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import Closeness, DenseReference
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning import need_usable
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage of compaction: its scene and its figures."""

    name: Literal["prune", "refine", "repair", "photos", "round"]
    scene: Gaussians
    """The scene after the share ``strength`` of the stage; after the whole stage, if it is left out."""
    after: Closeness | None
    """Errors of ``scene`` against the dense scene's renders; None if it was not compared."""
    before: Closeness | None = None
    """Errors of the scene before the stage; None for pruning."""
    strength: float = 1.0
    """Share of the change in ``scene``, in (0, 1]."""
    reason: Reason | None = None
    """Why the stage is left out; None if it is kept."""
    steps: int = 0
    """Number of steps of a repair."""
    seconds: float = 0.0
    """Duration of a repair."""
    interrupted: bool = False
    """Whether Ctrl-C ended a repair early."""
    photos: PhotoRepaired | None = None
    """Figures of optimising against photos."""

    @property
    def accepted(self) -> bool:
        """Whether the stage is kept."""
        return self.reason is None


@dataclass(frozen=True, eq=False)
class Compacted:
    """The result of :func:`pointsplat_ns.compact`: a smaller scene, and figures of every stage.

    Example:
        >>> import pointsplat_ns as ps
        >>> result = ps.compact(ps.example_room()[::10], keep="20%", effort="instant")
        >>> result.scene is (result.refined if result.accepted else result.pruned)
        True
    """

    stages: tuple[Stage, ...]
    """Pruning, then refinement, repair and rounding where they were tried. Scenes are on the dense scene's device."""
    notes: tuple[str, ...]
    """Lines of text: SH bands dropped, PSNR reached, origin of the views."""
    reference: DenseReference | None
    """Renders of the dense scene, for comparison with each stage; None if there are no views."""
    seconds: float
    """Total duration."""
    uncompared: str = ""
    """Why there are no views to compare renders in; empty if there are."""
    target: str = ""
    """Text on the search for targets: the cost, and the target that the next cheaper scene misses; empty if there was
    no search."""
    interrupted: bool = False
    """Whether Ctrl-C ended the repair or the search for targets early."""

    def _stage(self, name: str) -> Stage | None:
        return next((stage for stage in self.stages if stage.name == name), None)

    @property
    def last(self) -> Stage:
        """The last stage that was kept."""
        return _last_kept(self.stages)

    @property
    def scene(self) -> Gaussians:
        """The result: the scene after the last stage that was kept."""
        return self.last.scene

    @property
    def pruned(self) -> Gaussians:
        """The scene before refinement."""
        return self.stages[0].scene

    @property
    def refined(self) -> Gaussians:
        """The scene after refinement at ``strength``; ``pruned`` if there is no refiner."""
        return (self._stage("refine") or self.stages[0]).scene

    @property
    def strength(self) -> float:
        """Accepted share of the refiner's residuals in ``refined``, in (0, 1]; 1 if none is accepted."""
        return (self._stage("refine") or self.stages[0]).strength

    @property
    def accepted(self) -> bool:
        """Whether the refinement was kept."""
        refined = self._stage("refine")
        return refined is not None and refined.accepted

    @property
    def repaired(self) -> Stage | None:
        """The repair; None if there was none."""
        return self._stage("repair")

    @property
    def repair_accepted(self) -> bool:
        """Whether the repair was kept."""
        return self.repaired is not None and self.repaired.accepted

    @property
    def photo_psnr(self) -> float | None:
        """PSNR of ``scene`` in the compared training photos, dB; None if it was not trained on photos."""
        trained = self._stage("photos")
        if trained is None or trained.photos is None:
            return None
        return trained.photos.after if trained.accepted else trained.photos.before

    @property
    def before(self) -> Closeness | None:
        """Errors of ``pruned`` against the reference; None if there are no views."""
        return self.stages[0].after

    @property
    def after(self) -> Closeness | None:
        """Errors of ``refined`` against the reference; None if it was not compared."""
        refined = self._stage("refine")
        return None if refined is None else refined.after

    @property
    def after_repair(self) -> Closeness | None:
        """Errors of the repaired scene; None if there is none."""
        return None if self.repaired is None else self.repaired.after

    @property
    def closeness(self) -> Closeness | None:
        """Errors of ``scene`` against the reference; None if nothing was compared."""
        return self.last.after

    @property
    def psnr(self) -> float | None:
        """PSNR of ``scene`` against the dense scene's renders over the pixels that the dense scene covers, dB; None if
        nothing was compared."""
        return None if self.closeness is None else self.closeness.psnr

    @property
    def views(self) -> Views | None:
        """The views that renders were compared in."""
        return None if self.reference is None else self.reference.views

    @property
    def verdict(self) -> str:
        """Text on refinement and repair, one line each: the gain, or the reason to leave it out."""
        from pointsplat_ns.compression.verdicts import verdict_of

        return verdict_of(self)


def compact_scene(
    dense: Gaussians,
    request: CompactRequest,
    views: ViewSource | None = None,
    progress: Progress = silent,
    photos: Photos | None = None,
) -> Compacted:
    """Make a scene smaller, refine it if there is a refiner, and repair it for the budget of the request. Scenes of the
    result are on the device of ``dense``. By default views are sampled. With ``photos``, the scene is
    trained on them last, if the request has a budget for it.

    Refinement and repair are accepted by comparing renders with those of the dense scene
    (:mod:`~pointsplat_ns.compression.acceptance`). A requested PSNR (``auto``) is reached before refinement, so that it
    holds in any case. The repair uses other views than the comparison.

    Raises:
        BudgetError, SceneError, PointSplatError: as :func:`~pointsplat_ns.compression.prune.prune_scene`.
        SceneError: if the SH degree exceeds the refiner's.
        DataError: if the budget or ``sh`` needs views and there are none.
    """
    start = time.perf_counter()
    need_usable(dense)
    request.check_sh_degree(dense)
    views = views or ViewSource(dense)
    pruned = prune_scene(dense, request.prune, views, progress, rounding=False)
    at_work = dense.to(request.device)
    judge, before, uncompared = None, None, ""
    try:
        progress("comparing renders", 0.0)
        judge = Comparison(at_work, views)
        before = judge.reference.closeness(pruned.scene.to(at_work.device))
    except DataError as error:
        uncompared = str(error)
    stages = [Stage("prune", pruned.scene, before)]
    for stage in (_refine, _repair):
        made = stage(_last_kept(stages), at_work, request, judge, views, progress)
        stages += [] if made is None else [made]
    stopped = any(stage.interrupted for stage in stages)
    if photos is not None and request.photos is not None and not request.photos.empty and not stopped:
        stages.append(_on_photos(_last_kept(stages), at_work, request.photos, photos, judge, views, progress))
    if pruned.limit is not None:
        stages += rounding_stage(_last_kept(stages), pruned.limit, None if judge is None else judge.reference)
    notes = pruned.notes
    if views.origin and views.text not in notes:
        notes = (views.text, *notes)
    reference = None if judge is None else judge.reference
    interrupted = any(stage.interrupted for stage in stages)
    seconds = time.perf_counter() - start
    return Compacted(tuple(stages), notes, reference, seconds, uncompared, interrupted=interrupted)


def as_compacted(dense: Gaussians, pruned: Gaussians, views: ViewSource, notes: tuple[str, ...]) -> Compacted:
    """The result of :func:`compact_scene` for a scene that is only pruned, with notes on the pruning."""
    reference = DenseReference(dense, views.compared())
    return Compacted((Stage("prune", pruned, reference.closeness(pruned)),), notes, reference, 0.0)


def _last_kept(stages: Sequence[Stage]) -> Stage:
    return next(stage for stage in reversed(stages) if stage.accepted)


def _refine(
    last: Stage,
    dense: Gaussians,
    request: CompactRequest,
    judge: Comparison | None,
    views: ViewSource,
    progress: Progress,
) -> Stage | None:
    """The refinement by a network; None if there is none. Arguments as of :func:`_repair`."""
    if request.refiner is None:
        return None
    progress("refining", 0.0)
    refined = request.refiner(last.scene)
    if bool((last.scene.usable() & ~refined.usable()).any()):
        return Stage("refine", refined, None, last.after, reason=Reason.NOT_FINITE)
    if judge is None or last.after is None:
        return Stage("refine", refined, None, reason=Reason.NOT_COMPARED)
    change = accept_change(judge, last.after, last.scene, refined, progress)
    scene = change.scene if change.reason is None else refined
    return Stage("refine", scene, change.closeness, last.after, change.strength, change.reason)


def _repair(
    last: Stage,
    dense: Gaussians,
    request: CompactRequest,
    judge: Comparison | None,
    views: ViewSource,
    progress: Progress,
) -> Stage | None:
    """The repair of the last stage that was kept; None if its budget is empty, there are no views (and so no judge), or
    the scene has no error. ``dense`` is on the device that renders."""
    if judge is None or last.after is None or request.repair.empty or last.after.psnr == math.inf:
        return None
    progress("repairing", 0.0)
    report = functools.partial(progress, "repairing")
    repaired = repair(last.scene.to(dense.device), dense, views, request.repair, report, psnr=last.after.psnr)
    change = accept_change(judge, last.after, last.scene, repaired.scene)
    scene = change.scene if change.reason is None else repaired.scene.to(last.scene.device)
    figures = (repaired.steps, repaired.seconds, repaired.interrupted)
    return Stage("repair", scene, change.closeness, last.after, change.strength, change.reason, *figures)


def rounding_stage(last: Stage, limit: FileLimit, reference: DenseReference | None) -> list[Stage]:
    """The last scene, rounded for a compressed file; empty if it is kept as it is."""
    scene = limit.rounded(last.scene)
    if scene is last.scene:
        return []
    after = None if reference is None else reference.closeness(scene.to(reference.renders[0].device))
    return [Stage("round", scene, after, last.after)]


def _on_photos(
    last: Stage,
    dense: Gaussians,
    budget: PhotoBudget,
    photos: Photos,
    judge: Comparison | None,
    views: ViewSource,
    progress: Progress,
) -> Stage:
    """The scene after optimising against photos; arguments as of :func:`_repair`."""
    progress("training on photos", 0.0)
    report = functools.partial(progress, "training on photos")
    trained = photo_repair(last.scene.to(dense.device), dense, photos, views, budget, report)
    reason = None if trained.after > trained.before else Reason.NO_GAIN
    after = None if judge is None else judge.reference.closeness(trained.scene)
    scene, figures = trained.scene.to(last.scene.device), (trained.steps, trained.seconds, trained.interrupted)
    return Stage("photos", scene, after, last.after, 1.0, reason, *figures, photos=trained)
