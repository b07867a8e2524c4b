"""Runs a request from the scene's file to a report, for both the public functions and the
commands."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.pipeline.cleaning import Cleaning, clean_scene
from pointsplat_ns.pipeline.compact_scene import compact_scene, compact_to_quality
from pointsplat_ns.pipeline.options import (
    CompactOptions,
    PruneOptions,
    ViewOptions,
    default_device,
)
from pointsplat_ns.pipeline.photos.posed_photos import held_out_psnrs
from pointsplat_ns.pipeline.prune_file import prune_file, rows_to_prune
from pointsplat_ns.pipeline.prune_scene import prune_scene
from pointsplat_ns.pipeline.quality import Judge, judge_of
from pointsplat_ns.pipeline.report import Report, StageResult, last_accepted
from pointsplat_ns.pipeline.subject import Source, Subject, read_subject
from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import need_usable
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import read_ply
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.cluster import connected
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.system.workers import check_jobs


@dataclass(frozen=True, eq=False)
class Outcome:
    """A finished request."""

    report: Report
    views: ViewProvider | None
    """Source of the views; None if the scene is larger than memory."""

    @property
    def judge(self) -> Judge | None:
        """Judge of the result's file; None if no view can be found."""
        if self.report.judge is not None or self.report.dense is None or self.views is None:
            return self.report.judge
        return judge_of(self.report.dense, self.views)


@normal_mode
def prune(
    scene: Source,
    options: PruneOptions,
    *,
    views: Views | None = None,
    output: Path | None = None,
    memory: float | None = None,
    jobs: int | None = None,
    cluster: str | None = None,
    progress: bool | Progress = False,
) -> Outcome:
    """Read a scene and prune it. A PLY that does not fit into memory is merged in cells.

    Args:
        scene: N Gaussians, or the path of a scene.
        options: budget, method and views.
        views: known views, in place of ``options.poses``.
        output: PLY for the result of a scene larger than memory; a hidden folder beside it lets a
            killed call resume. By default a temporary file, which is then read.
        memory: limit in bytes; by default the free memory.
        jobs: number of processes that share the cells, each within ``memory``.
        cluster: address of a dask cluster whose workers share the cells instead, each within
            ``memory``; they see the folder of ``output``.
        progress: True shows a bar; a function is called with the current task and its share done.

    Raises:
        PointSplatError: as :func:`pointsplat_ns.prune`.
    """
    options.check()
    rows = None
    if not isinstance(scene, Gaussians) and views is None:
        rows = rows_to_prune(Path(scene), options, memory)
    for option, given in (("--jobs", jobs), ("--cluster", cluster)):
        if rows is None and given is not None:
            raise SceneError(
                f"{scene}: fits into memory; expected no {option}, which is for merging in parts"
            )
    if rows is None:
        return _prune_in_memory(scene, options, views, progress)
    if options.photos is not False:
        raise SceneError(f"{scene}: does not fit into memory; expected no --photos")
    processes = 1 if jobs is None else jobs
    check_jobs(processes, cluster)
    with (
        connected(cluster) as machines,
        progress_bar(progress) as report,
        tempfile.TemporaryDirectory() as folder,
    ):
        target = Path(folder) / "merged.ply" if output is None else output
        before, seconds = prune_file(rows, target, options, memory, report, processes, machines)
        stages: tuple[StageResult, ...] = ()
        if output is None:
            stages = (StageResult("merge", read_ply(target), after=None),)
    done = Report(
        stages=stages, by=options.by, count_before=before, seconds=seconds, written=output
    )
    return Outcome(report=done, views=None)


def _prune_in_memory(
    scene: Source, options: PruneOptions, views: Views | None, progress: bool | Progress
) -> Outcome:
    with progress_bar(progress) as report:
        subject = read_subject(scene, options, views, options.photos, False, report)
    provider = subject.views()
    start = time.perf_counter()
    with progress_bar(progress) as report:
        pruned = prune_scene(subject.dense.to(default_device()), options, provider, report)
        small = pruned.scene.to(subject.dense.device)
        seconds = time.perf_counter() - start
    stage = "merge" if options.method.score is None else "prune"
    done = Report(
        stages=(StageResult(stage, small, after=None),),  # type: ignore[arg-type]
        by=options.by,
        count_before=len(subject.dense),
        seconds=seconds,
        origin=provider.origin,
        sh=pruned.sh,
        cleaning=pruned.cleaning,
        search=pruned.search,
        dense=subject.dense,
    )
    return Outcome(report=_with_held_out(done, subject, (small,)), views=provider)


@normal_mode
def compact(
    scene: Source,
    options: CompactOptions,
    refiner: TrainedRefiner | None = None,
    *,
    views: Views | None = None,
    state_file: Path | None = None,
    progress: bool | Progress = False,
) -> Outcome:
    """Read a scene and compact it.

    Args:
        scene: N Gaussians, or the path of a scene.
        options: budget, method, repair and views.
        refiner: trained network of ``options.refiner``.
        views: known views, in place of ``options.poses``.
        state_file: file with the state of a long repair, from which a killed command continues.
        progress: as for :func:`prune`.

    Raises:
        PointSplatError: as :func:`pointsplat_ns.compact`.
    """
    options = options.completed(refiner)
    with progress_bar(progress) as report:
        subject = read_subject(scene, options, views, options.photos, True, report)
    provider = subject.views()
    dense = subject.dense
    with progress_bar(progress) as report:
        if options.searched:
            done = compact_to_quality(
                dense, options, provider, report, subject.training, subject.held_out, refiner
            )
        else:
            done = compact_scene(
                dense, options, provider, report, subject.training, refiner, state_file
            )
    places = [place for place, stage in enumerate(done.stages) if stage.photos is not None]
    before_photos = done.stages[: places[0]] if places else done.stages
    results = (last_accepted(before_photos).scene, done.scene)
    return Outcome(report=_with_held_out(done, subject, results), views=provider)


def _with_held_out(done: Report, subject: Subject, results: tuple[Gaussians, ...]) -> Report:
    """The report with the PSNR of ``results`` in held-out photos, if there are any."""
    dense = subject.dense.to(default_device())
    return replace(
        done,
        held_out=held_out_psnrs(dense, results, subject.held_out),
        no_held_out=subject.no_held_out,
    )


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A cleaned scene."""

    dense: Gaussians
    scene: Gaussians
    cleaning: Cleaning
    seconds: float
    views: ViewProvider


@normal_mode
def clean(
    scene: Source,
    strength: float,
    options: ViewOptions,
    *,
    views: Views | None = None,
    progress: bool | Progress = False,
) -> Cleaned:
    """Read a scene and clean it, as :func:`pointsplat_ns.clean`."""
    options.check()
    if not 0 <= strength <= 1:
        raise PointSplatError(f"strength {strength!r}: expected a number in [0, 1]")
    subject = read_subject(scene, options, views)
    dense = subject.dense
    need_usable(dense)
    provider = subject.views()
    start = time.perf_counter()
    with progress_bar(progress) as report:
        cleaning = clean_scene(dense, 1, provider, report, strength)
        cleaned = cleaning.apply(dense, 1)
    return Cleaned(
        dense=dense,
        scene=cleaned,
        cleaning=cleaning,
        seconds=time.perf_counter() - start,
        views=provider,
    )
