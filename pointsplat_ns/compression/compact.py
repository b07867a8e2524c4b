"""Compacts a scene in stages: prune, refine, repair, and round for a file of limited size.
Refinement and repair are accepted by comparing renders with those of the dense scene. For a quality
after all stages, counts are searched."""

from __future__ import annotations

import functools
import itertools
import math
import time
from dataclasses import replace
from pathlib import Path

from pointsplat_ns.comparing.closeness import DenseReference
from pointsplat_ns.compression.acceptance import Comparison
from pointsplat_ns.compression.budget_search import FileLimit, smallest_within
from pointsplat_ns.compression.compacted import Compacted, Stage, last_kept
from pointsplat_ns.compression.photo_repair import PHOTO_REPAIR, PhotoRepaired, photo_repair
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.quality import Judge, decibels, through_file
from pointsplat_ns.compression.repair import repair
from pointsplat_ns.compression.requests import CompactRequest, RepairBudget
from pointsplat_ns.compression.trained_refiner import TrainedRefiner
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.rounding import ROUNDING, rounding_for
from pointsplat_ns.photos.examples import Photos, mean_psnr
from pointsplat_ns.system.progress import Progress, silent, within
from pointsplat_ns.system.quantities import counted
from pointsplat_ns.view_source import ViewSource


def compact_scene(
    dense: Gaussians,
    request: CompactRequest,
    views: ViewSource | None = None,
    progress: Progress = silent,
    photos: Photos | None = None,
) -> Compacted:
    """Make a scene smaller, refine it if there is a refiner, and repair it for the budget of the
    request. Scenes of the result are on the device of ``dense``. By default views are sampled. With
    ``photos``, and a budget for it, the scene is trained on them, and repaired only where that
    harms: a repair before brings nothing (a tenth of fox, figure, ray and vr_project: within 0.1 dB
    in held-out photos, and within 0.2 dB in sampled views), unless the scene is large.

    Refinement and repair are accepted by comparing renders with those of the dense scene
    (:mod:`~pointsplat_ns.compression.acceptance`). A requested PSNR (``auto``) is reached before
    refinement, so that it holds in any case. The repair uses other views than the comparison.

    Raises:
        BudgetError, SceneError, PointSplatError: as
            :func:`~pointsplat_ns.compression.prune.prune_scene`.
        SceneError: if the SH degree exceeds the refiner's.
        DataError: if the budget or ``sh`` needs views and there are none.
    """
    start = time.perf_counter()
    request.check_sh_degree(dense)
    views = views or ViewSource(dense)
    at_work = dense.to(request.device)
    pruned = prune_scene(at_work, request.prune, views, progress, rounding=False)
    pruned = replace(pruned, scene=pruned.scene.to(dense.device))
    judge = None
    reference = None
    uncompared = ""
    try:
        progress("comparing renders", 0.0)
        judge = Comparison(at_work, views)
        reference = judge.reference
    except DataError as error:
        uncompared = f"it cannot be compared with the dense scene ({error})"
    before = None if reference is None else reference.closeness(pruned.scene.to(at_work.device))
    stages = [
        Stage("merge" if request.prune.method.score is None else "prune", pruned.scene, before)
    ]
    if request.refiner is not None:
        kept = len(pruned.scene) / max(1, len(dense))
        stages.append(_refined(stages[0], request.refiner, kept, judge, uncompared, progress))
    left = last_kept(stages)
    comparable = left.after is not None and left.after.psnr < math.inf and not request.repair.empty
    repairing = judge if comparable else None
    budget = request.photos
    training = None if budget is None or budget.empty else photos
    if repairing is not None and (training is None or len(left.scene) > PHOTO_REPAIR.large):
        stages.append(
            repaired_stage(
                left, at_work, request.repair, repairing, views, progress, request.unfinished
            )
        )
        repairing = None
    if training is not None and budget is not None and not stages[-1].interrupted:
        progress("training on photos", 0.0)
        report = functools.partial(progress, "training on photos")
        scene = last_kept(stages).scene.to(at_work.device)
        trained = photo_repair(scene, at_work, training, views, budget, report)
        if repairing is not None and trained.why_not() and not trained.interrupted:
            stages.append(
                repaired_stage(
                    left, at_work, request.repair, repairing, views, progress, request.unfinished
                )
            )
            if stages[-1].accepted:
                trained = trained.beside(stages[-1].scene.to(at_work.device), training)
        stages.append(_trained(last_kept(stages), trained, reference))
    interrupted = any(stage.interrupted for stage in stages)
    if pruned.limit is not None:
        stages += rounding_stage(last_kept(stages), pruned.limit, reference)
    seen = (views.text,) if views.origin and views.text not in pruned.notes else ()
    seconds = time.perf_counter() - start
    return Compacted(
        tuple(stages),
        (*seen, *pruned.notes),
        reference,
        seconds,
        uncompared,
        interrupted=interrupted,
    )


def _refined(
    last: Stage,
    refiner: TrainedRefiner,
    kept: float,
    judge: Comparison | None,
    uncompared: str,
    progress: Progress,
) -> Stage:
    """The refinement of the last stage, which holds the share ``kept`` of the dense scene, by a
    network."""
    progress("refining", 0.0)
    refined = refiner(last.scene, kept)
    unsound = int((last.scene.usable() & ~refined.usable()).sum())
    if unsound:
        return Stage(
            "refine",
            refined,
            None,
            last.after,
            f"{unsound:,} of {len(refined):,} Gaussians are not finite",
        )
    if judge is None or last.after is None:
        return Stage("refine", refined, None, reason=uncompared)
    after, reason = judge.judged(last.after, last.scene, refined, progress)
    return Stage("refine", refined, after, last.after, reason)


def repaired_stage(
    last: Stage,
    dense: Gaussians,
    budget: RepairBudget,
    judge: Comparison,
    views: ViewSource,
    progress: Progress,
    unfinished: Path | None = None,
) -> Stage:
    """The repair of the last stage that was kept, which was compared; ``dense`` is on the device
    that renders."""
    assert last.after is not None
    progress("repairing", 0.0)
    report = functools.partial(progress, "repairing")
    scene = last.scene.to(dense.device)
    psnr = last.after.psnr
    repaired = repair(scene, dense, views, budget, report, psnr=psnr, unfinished=unfinished)
    after, reason = judge.judged(last.after, last.scene, repaired.scene)
    scene = repaired.scene.to(last.scene.device)
    figures = (repaired.steps, repaired.seconds, repaired.interrupted)
    return Stage("repair", scene, after, last.after, reason, *figures)


def _trained(last: Stage, trained: PhotoRepaired, reference: DenseReference | None) -> Stage:
    """The scene that was trained on photos, and compared in them with the last stage that was
    kept."""
    most_lost = PHOTO_REPAIR.most_lost if last.name == "repair" else 0.0
    after = None if reference is None else reference.closeness(trained.scene)
    scene = trained.scene.to(last.scene.device)
    figures = (trained.steps, trained.seconds, trained.interrupted)
    return Stage(
        "photos", scene, after, last.after, trained.why_not(most_lost), *figures, photos=trained
    )


def rounding_stage(last: Stage, limit: FileLimit, reference: DenseReference | None) -> list[Stage]:
    """The last scene, rounded for a compressed file; empty if it is kept as it is."""
    scene = limit.rounded(last.scene)
    if scene is last.scene:
        return []
    after = (
        None if reference is None else reference.closeness(scene.to(reference.renders[0].device))
    )
    return [Stage("round", scene, after, last.after)]


def compact_to_psnr(
    dense: Gaussians,
    request: CompactRequest,
    views: ViewSource,
    progress: Progress = silent,
    photos: Photos | None = None,
    held_out: Photos = (),
) -> Compacted:
    """:func:`compact_scene` with the fewest Gaussians that reach ``target_db`` of the request, or
    lose at most ``most_lost`` in the held-out photos, in place of its budget.

    Each count is judged after writing and reading the scene in the format of the request: as every
    command judges (:mod:`~pointsplat_ns.compression.quality`), or in the photos. Ctrl-C ends the
    search with the smallest scene found so far, if any.

    Raises:
        BudgetError: if not even all Gaussians reach it.
        SceneError, PointSplatError: as :func:`compact_scene`.
        DataError: if there are no views, or no held-out photos where these judge.
    """
    start = time.perf_counter()
    suffix = request.prune.suffix
    numbers = itertools.count(1)
    judge = Judge(dense, views)
    kind = format_to_write(suffix)
    device = request.device
    every = [*range(len(held_out))]
    known = 0.0
    if request.most_lost is not None:
        if not every:
            raise DataError(
                "there are no held-out photos, in which --keep auto judges; expected a budget, "
                "such as 10%"
            )
        known = mean_psnr(dense.to(device), held_out, every)

    def measure(count: int) -> tuple[float, Compacted]:
        asked = replace(request, prune=replace(request.prune, keep=count))
        made = compact_scene(dense, asked, views, within(f"size {next(numbers)}", progress), photos)
        if made.interrupted:
            raise KeyboardInterrupt
        if kind.rounded is not None and (psnr := judge.psnr(made.scene)[0]) <= ROUNDING.best_psnr:
            limit = FileLimit(kind, math.inf, rounding_for(psnr, made.scene.sh_degree))
            made = replace(
                made, stages=(*made.stages, *rounding_stage(made.last, limit, made.reference))
            )
        written_bytes, written = through_file(made.scene, suffix)
        if request.most_lost is None:
            psnr, _ = judge.psnr(written)
            reached = f"{decibels(psnr)} against the dense scene in {judge.where}"
        else:
            psnr = mean_psnr(written.to(device), held_out, every)
            reached = (
                f"{psnr:.1f} dB in {counted(len(every), 'held-out photo')}, the dense scene "
                f"{known:.1f} dB"
            )
        return psnr, replace(
            made, target=f"{reached}, {bytes_text(written_bytes)}, {len(made.scene):,} Gaussians"
        )

    if request.target_db is not None:
        best, found = smallest_within(len(dense), measure, request.target_db, stoppable=True)
    else:  # trained on photos, a tenth loses about 0.8 dB, and 30 % no PSNR on average
        least = known - (request.most_lost or 0.0)
        best, found = smallest_within(
            len(dense), measure, least, stoppable=True, first=0.15, slope=0.8
        )
    target = f"{best.target}; {len(found.tried)} sizes tried" + (
        ", interrupted" if found.interrupted else ""
    )
    seconds = time.perf_counter() - start
    return replace(best, target=target, judge=judge, interrupted=found.interrupted, seconds=seconds)
