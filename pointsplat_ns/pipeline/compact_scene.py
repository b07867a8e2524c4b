"""Compacts a scene in stages: prune, refine, repair, and round for a file of limited size.

Refinement and repair are accepted by comparing renders with those of the dense scene. For a quality
after all stages, counts are searched.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import replace
from pathlib import Path

from pointsplat_ns.errors import DataError
from pointsplat_ns.pipeline.acceptance import Comparison
from pointsplat_ns.pipeline.budget_search import FileLimit, smallest_within
from pointsplat_ns.pipeline.options import CompactOptions, default_device
from pointsplat_ns.pipeline.photos.examples import Photos, mean_psnr
from pointsplat_ns.pipeline.prune_scene import prune_scene
from pointsplat_ns.pipeline.quality import Judge, through_file
from pointsplat_ns.pipeline.report import Report, StageResult, TargetSearch, last_accepted
from pointsplat_ns.pipeline.stages import Context, Refine, Repair, TrainOnPhotos, rounded
from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.scene.formats import format_to_write
from pointsplat_ns.scene.formats.rounding import ROUNDING, rounding_for
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.progress import Progress, silent, within


def compact_scene(
    dense: Gaussians,
    options: CompactOptions,
    views: ViewProvider | None = None,
    progress: Progress = silent,
    photos: Photos | None = None,
    refiner: TrainedRefiner | None = None,
    state_file: Path | None = None,
) -> Report:
    """Make a scene smaller, refine it if there is a refiner, and repair it.

    With ``photos``, and a budget for it, the scene is trained on them, and repaired only where that
    harms: a repair before brings nothing (a tenth of fox, figure, ray and vr_project: within 0.1 dB
    in held-out photos, and within 0.2 dB in sampled views), unless the scene is large.

    A requested PSNR (``auto``) is reached before refinement, so that it holds in any case. The
    repair uses other views than the comparison.

    Args:
        dense: N Gaussians.
        options: completed by :meth:`CompactOptions.completed`.
        views: by default sampled.
        progress: called with the name of the current task and the share of it that is done, in [0,
            1].
        photos: photos to train on.
        refiner: the network; scenes are computed on its device.
        state_file: file of the state of a long repair, from which it continues.

    Returns:
        The result. Its scenes are on the device of ``dense``.

    Raises:
        BudgetError, SceneError, PointSplatError: as
            :func:`~pointsplat_ns.pipeline.prune_scene.prune_scene`.
        SceneError: if the SH degree exceeds the refiner's.
        DataError: if the budget or ``sh`` needs views and there are none.
    """
    start = time.perf_counter()
    options.check_sh_degree(dense, refiner)
    views = views or ViewProvider(dense)
    at_work = dense.to(default_device() if refiner is None else refiner.device)
    pruned = prune_scene(at_work, options, views, progress, rounding=False)
    comparison = None
    uncompared = ""
    try:
        progress("comparing renders", 0.0)
        comparison = Comparison(at_work, views)
    except DataError as error:
        uncompared = str(error)
    context = Context(at_work, views, comparison, uncompared, progress)
    reference = context.reference
    results = [
        StageResult(
            stage="merge" if options.method.score is None else "prune",
            scene=pruned.scene.to(dense.device),
            after=None if reference is None else reference.closeness(pruned.scene),
        )
    ]
    if refiner is not None:
        share = len(pruned.scene) / max(1, len(dense))
        results.append(Refine(refiner, share).run(results[0], context))
    results += _repaired(last_accepted(results), options, context, photos, state_file)
    if pruned.limit is not None:
        last = last_accepted(results)
        result = rounded(last, pruned.limit, reference)
        results += [] if result is last else [result]
    return Report(
        stages=tuple(results),
        by=options.by,
        count_before=len(dense),
        seconds=time.perf_counter() - start,
        origin=views.origin,
        sh=pruned.sh,
        cleaning=pruned.cleaning,
        search=pruned.search,
        reference=reference,
        uncompared=uncompared,
        interrupted=any(result.interrupted for result in results),
        dense=dense,
    )


def _repaired(
    last: StageResult,
    options: CompactOptions,
    context: Context,
    photos: Photos | None,
    state_file: Path | None,
) -> list[StageResult]:
    """The repair of the last accepted stage, or the training on photos; both for large scenes, and
    where training harms photos outside of its steps."""
    repair = Repair(options.repair, state_file)
    budget = options.photo_budget
    if photos is None or budget is None or budget.empty:
        return [repair.run(last, context)] if repair.applies(last) else []
    training = TrainOnPhotos(photos, budget)
    repairable = repair.applies(last)
    if repairable and training.needs_repair_before(len(last.scene)):
        repaired = repair.run(last, context)
        if repaired.interrupted:
            return [repaired]
        return [repaired, training.run(last_accepted([last, repaired]), context)]
    trained = training.run(last, context)
    if trained.accepted or trained.interrupted or not repairable:
        return [trained]
    repaired = repair.run(last, context)
    if repaired.accepted:
        trained = training.beside(trained, repaired, context)
    return [repaired, trained]


def compact_to_quality(
    dense: Gaussians,
    options: CompactOptions,
    views: ViewProvider,
    progress: Progress = silent,
    photos: Photos | None = None,
    held_out: Photos = (),
    refiner: TrainedRefiner | None = None,
) -> Report:
    """:func:`compact_scene` with the fewest Gaussians that reach ``target_db`` of the options, or
    lose at most ``most_lost`` in the held-out photos, in place of a budget.

    Each count is judged after writing and reading the scene in the format of the options: as every
    command judges (:mod:`~pointsplat_ns.pipeline.quality`), or in the photos. Ctrl-C ends the
    search with the smallest scene found so far, if any.

    Raises:
        BudgetError: if not even all Gaussians reach it.
        SceneError, PointSplatError: as :func:`compact_scene`.
        DataError: if there are no views, or no held-out photos where these judge.
    """
    start = time.perf_counter()
    suffix = options.target_format
    numbers = itertools.count(1)
    judge = Judge(dense, views)
    kind = format_to_write(suffix)
    device = default_device() if refiner is None else refiner.device
    every = [*range(len(held_out))]
    known = 0.0
    if options.most_lost is not None:
        if not every:
            raise DataError(
                "there are no held-out photos, in which --keep auto judges; expected a budget, "
                "such as 10%"
            )
        known = mean_psnr(dense.to(device), held_out, every)

    def measure(count: int) -> tuple[float, Report]:
        asked = replace(options, keep=count)
        report = within(f"size {next(numbers)}", progress)
        made = compact_scene(dense, asked, views, report, photos, refiner)
        if made.interrupted:
            raise KeyboardInterrupt
        if kind.rounded is not None and (psnr := judge.psnr(made.scene)[0]) <= ROUNDING.best_psnr:
            limit = FileLimit(kind, math.inf, rounding_for(psnr, made.scene.sh_degree))
            result = rounded(made.last, limit, made.reference)
            if result is not made.last:
                made = replace(made, stages=(*made.stages, result))
        written_bytes, written = through_file(made.scene, suffix)
        if options.most_lost is None:
            psnr, _ = judge.psnr(written)
        else:
            psnr = mean_psnr(written.to(device), held_out, every)
        target = TargetSearch(
            psnr=psnr,
            bytes=written_bytes,
            gaussians=len(made.scene),
            photos=0 if options.most_lost is None else len(every),
            dense_psnr=known,
        )
        return psnr, replace(made, target=target)

    if options.target_db is not None:
        best, found = smallest_within(len(dense), measure, options.target_db, stoppable=True)
    else:  # trained on photos, a tenth loses about 0.8 dB, and 30 % no PSNR on average
        least = known - (options.most_lost or 0.0)
        best, found = smallest_within(
            len(dense), measure, least, stoppable=True, first=0.15, slope=0.8
        )
    assert best.target is not None
    return replace(
        best,
        target=replace(best.target, tried=len(found.tried), interrupted=found.interrupted),
        judge=judge,
        interrupted=found.interrupted,
        seconds=time.perf_counter() - start,
    )
