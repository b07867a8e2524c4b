"""Compacts a scene in stages: prune, refine, repair, round for a file of limited size.

Refinement and repair are accepted by comparing renders with the dense scene's. For a target quality
after all stages, the count is searched for.
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

    With ``photos`` and a budget for them, the scene is trained on photos. It is repaired only if
    the training harms it: a repair before the training gains nothing (a tenth of fox, figure, ray
    and vr_project: within 0.1 dB in held-out photos and 0.2 dB in sampled views), unless the scene
    is large.

    Pruning alone reaches a requested PSNR (``auto``), so it holds whether or not later stages are
    accepted. Repair and comparison use different views.

    Args:
        dense: N Gaussians.
        options: completed by :meth:`CompactOptions.completed`.
        views: by default sampled.
        progress: called with the name of the current task and the share of it that is done, in [0,
            1].
        photos: photos to train on.
        refiner: trained network; its device computes all stages.
        state_file: file with the state of a long repair, from which a killed command continues.

    Returns:
        The result. Scenes are on the device of ``dense``.

    Raises:
        BudgetError, SceneError, PointSplatError: as
            :func:`~pointsplat_ns.pipeline.prune_scene.prune_scene`.
        SceneError: if the SH degree exceeds the refiner's.
        DataError: if the budget or ``sh`` needs views and there are none.
    """
    start = time.perf_counter()
    options.check_sh_degree(dense, refiner)
    views = views or ViewProvider(dense)
    dense_on_device = dense.to(default_device() if refiner is None else refiner.device)
    pruned = prune_scene(dense_on_device, options, views, progress, rounding=False)
    comparison = None
    uncompared = ""
    try:
        progress("comparing renders", 0.0)
        comparison = Comparison(dense_on_device, views)
    except DataError as error:
        uncompared = str(error)
    context = Context(
        dense=dense_on_device,
        views=views,
        comparison=comparison,
        uncompared=uncompared,
        progress=progress,
    )
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
    """Repair the last accepted stage, or train it on photos. Both run for large scenes, and where
    training harms photos outside of its steps."""
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
        trained = training.against(trained, repaired, context)
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
    """:func:`compact_scene` with the fewest Gaussians that reach a quality, in place of a budget.

    The quality is ``target_db`` of the options, judged as by every command
    (:mod:`~pointsplat_ns.pipeline.quality`), or a loss of at most ``most_lost`` in held-out photos.
    Each candidate is judged after writing and reading it in the target format. Ctrl-C ends the
    search with the smallest scene that reaches the quality so far, if any.

    Raises:
        BudgetError: if all Gaussians miss it.
        SceneError, PointSplatError: as :func:`compact_scene`.
        DataError: if there are no views, or no held-out photos to judge by.
    """
    start = time.perf_counter()
    numbers = itertools.count(1)
    judge = Judge(dense, views)
    kind = options.format_of(options.target_format)
    device = default_device() if refiner is None else refiner.device
    photo_indices = [*range(len(held_out))]
    dense_psnr = 0.0
    if options.most_lost is not None:
        if not photo_indices:
            raise DataError(
                "there are no held-out photos for --keep auto to judge by; expected a budget, such "
                "as 10%"
            )
        dense_psnr = mean_psnr(dense.to(device), held_out, photo_indices)

    def measure(count: int) -> tuple[float, Report]:
        sized = replace(options, keep=count)
        report = within(f"size {next(numbers)}", progress)
        candidate = compact_scene(dense, sized, views, report, photos, refiner)
        if candidate.interrupted:
            raise KeyboardInterrupt
        psnr = math.inf if kind.rounded is None else judge.psnr(candidate.scene)[0]
        if kind.rounded is not None and psnr <= ROUNDING.best_psnr:
            limit = FileLimit(kind, math.inf, rounding_for(psnr, candidate.scene.sh_degree))
            result = rounded(candidate.last, limit, candidate.reference)
            if result is not candidate.last:
                candidate = replace(candidate, stages=(*candidate.stages, result))
        written_bytes, written = through_file(candidate.scene, kind)
        if options.most_lost is None:
            psnr, _ = judge.psnr(written)
        else:
            psnr = mean_psnr(written.to(device), held_out, photo_indices)
        target = TargetSearch(
            psnr=psnr,
            bytes=written_bytes,
            gaussians=len(candidate.scene),
            photos=0 if options.most_lost is None else len(photo_indices),
            dense_psnr=dense_psnr,
        )
        return psnr, replace(candidate, target=target)

    if options.target_db is not None:
        best, found = smallest_within(len(dense), measure, options.target_db, stoppable=True)
    else:  # trained on photos, a tenth loses about 0.8 dB on average, and 30 % loses none
        least = dense_psnr - (options.most_lost or 0.0)
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
