"""Works on every scene of a folder, and writes a table of the results: compacts them, or, in
:mod:`~pointsplat_ns.tools.folder_conversion`, converts them.

``room.ply.json`` is the record of the result ``room.ply``. A result is finished if its record
matches two hashes: of the input file with the options, and of the result itself.
"""

from __future__ import annotations

import dataclasses
import functools
import glob
import hashlib
import json
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import torch

from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.pipeline.compact_scene import compact_scene, compact_to_quality
from pointsplat_ns.pipeline.options import CompactOptions
from pointsplat_ns.pipeline.quality import judge_of, read_back
from pointsplat_ns.pipeline.repair_budget import Effort
from pointsplat_ns.pipeline.trained_refiner import SHIPPED, TrainedRefiner, load_refiner
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.pruning import Keep
from pointsplat_ns.rendering.comparison.sizes import size_text
from pointsplat_ns.scene.discovery import FOLDER_FILES, find_scenes
from pointsplat_ns.scene.formats import SPZ_VERSION, Format, format_like
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene, save_as, source_file, source_parts
from pointsplat_ns.system.cluster import LostWorkError, connected
from pointsplat_ns.system.files import (
    content_hash,
    json_text,
    logger,
    need_folder,
    need_new,
    need_suffix,
    one_line,
    read_text,
    replacing,
    require_memory,
    write_csv,
    write_json,
)
from pointsplat_ns.system.outputs import (
    claim,
    is_own_file,
    need_no_links,
    outputs_claimed,
    unnamed,
)
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.system.workers import Workers, check_jobs
from pointsplat_ns.tools.pages.gallery import draw_pair, pair_of, write_gallery, write_sheet
from pointsplat_ns.tools.wording import quality_line

FIGURES = ("before", "after", "megabytes_before", "megabytes", "psnr", "seconds")
"""Numeric fields of a record."""


@dataclass(frozen=True)
class SceneResult:
    """The result of one scene of a folder.

    Example:
        >>> import pointsplat_ns as ps
        >>> print(ps.SceneResult("hall", "hall.ply", "small/hall.ply", "done", psnr=28.0))
        28.0 dB: edges of small things blur
    """

    name: str
    """Path relative to the folder, without suffix."""
    source: str
    """Path of the file or run."""
    output: str
    """Path of the result."""
    status: Literal["done", "done before", "failed", "open"]
    """``done before``: finished by an earlier call; ``open``: not finished."""
    before: int | None = None
    """Number of Gaussians of the scene."""
    after: int | None = None
    """Number of Gaussians of the result."""
    megabytes_before: float | None = None
    """Size of the scene's file, 10^6 bytes."""
    megabytes: float | None = None
    """Size of the result, 10^6 bytes."""
    psnr: float | None = None
    """PSNR against renders of the scene, dB; None if not compared, or equal."""
    seconds: float | None = None
    """Duration."""
    error: str = ""
    """Error in one line; empty if there was none."""
    note: str = ""
    """Note on the result; empty if there is none."""

    def __str__(self) -> str:
        """Text on the quality of the result, for users."""
        quality = "" if self.psnr is None else quality_line(self.psnr, None)
        return "; ".join(filter(None, (quality, self.note)))


@normal_mode
@outputs_claimed()
def compact_folder(
    folder: str | Path,
    output: str | Path | None = None,
    keep: Keep | str | None = None,
    refiner: str | Path | None = None,
    *,
    by: str | None = None,
    opacity_weight: float | None = None,
    sh: str = "all",
    clean: bool = False,
    effort: Effort = "quick",
    seconds: float | None = None,
    target_db: float | None = None,
    resolution: tuple[int, int] | str | None = None,
    data: str | Path | None = None,
    target_format: str | None = None,
    spz_version: int = SPZ_VERSION,
    html: str | Path | None = None,
    picture: str | Path | None = None,
    jobs: int = 1,
    cluster: str | None = None,
    force: bool = False,
    progress: bool | Progress = False,
) -> list[SceneResult]:
    """Compact every scene of a folder, as :func:`compact`, and write the results to another folder.

    Unchanged results of the same scenes and options are skipped, so a second call continues an
    interrupted one.

    Args:
        folder: folder of scenes: all files with Gaussians below it, and the newest Splatfacto run
            of each experiment.
        output: folder for the results ``NAME.ply``, their records ``NAME.ply.json``, and the table
            ``scenes.csv``; by default ``scenes_compact`` beside ``scenes``. Results have the format
            of their scene's file, or PLY if that format cannot be written.
        keep: as for :func:`compact`; a size such as "5MB" is the size of each result in its format.
        refiner: as for :func:`~pointsplat_ns.load_refiner`; None for no refiner.
        by, opacity_weight, sh, clean, effort, seconds, target_db, resolution: as for
            :func:`compact`, for each scene.
        data: folder above the data of the runs. A run without data gets sampled views and a note.
        target_format: suffix of all results, such as ".sog"; by default the format of each scene.
        spz_version: version of ``.spz`` results, as for :func:`~pointsplat_ns.save`.
        html: .html file for a gallery of all scenes before and after, with links to their files;
            written at the end.
        picture: .png file for the same pictures.
        jobs: number of processes, which share the cores. With more than one, the main code of the
            calling program must be under ``if __name__ == "__main__":``, as in any Python program
            that starts processes.
        cluster: address of a dask cluster, such as "tcp://host:8786", or its scheduler file. Its
            workers share the scenes, in place of processes here; all machines have the folders
            under the same paths.
        force: overwrite foreign files, changed files, and results of other options.
        progress: True shows a bar; a function is called with the name of the current task and its
            share done.

    Returns:
        The results, sorted by name. A failed scene has the status "failed" and does not stop the
        others.

    Raises:
        PointSplatError: if an option is invalid.
        DataError: if no cluster answers, or a worker does not see the folder of results.
        SceneError: if there is no scene, or the output folder, page or picture holds other results.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::100], f"{folder}/rooms/hall.ply")
        ...     [result] = ps.compact_folder(f"{folder}/rooms", keep=50, effort="instant")
        >>> result.name, result.status, result.before, result.after
        ('hall', 'done', 629, 50)
    """
    folder = Path(folder)
    target = output_folder(folder) if output is None else Path(output)
    trained = None if refiner is None else load_refiner(refiner, by=by)
    options = CompactOptions(
        keep=keep,
        by=by or "",
        opacity_weight=opacity_weight,
        sh=sh,  # type: ignore[arg-type]
        clean=clean,
        effort=effort,
        seconds=seconds,
        target_db=target_db,
        resolution=resolution,
        data=data,
        spz_version=spz_version,  # type: ignore[arg-type]
    ).completed(trained)
    size = options.size
    record: dict[str, str | float | bool | None] = {
        "keep": str(options.budget),
        "by": options.by,
        "sh": sh,
        "clean": clean,
        "effort": effort,
        "seconds": seconds,
        "target_db": target_db,
        "resolution": None if size is None else size_text(size),
        "data": None if data is None else str(data),
        "refiner": None if trained is None else source_file(trained.source).sha256,
        "format": target_format,
        "spz_version": spz_version,
    }
    work = _Compacting(
        record=record,
        drawn=(html, picture) != (None, None),
        force=force,
        options=options,
        refiner=refiner,
    )
    page, sheet = (None if path is None else Path(path) for path in (html, picture))
    return work_through(folder, target, work, target_format, jobs, progress, page, sheet, cluster)


def work_through(
    folder: Path,
    target: Path,
    work: FolderWork,
    target_format: str | None = None,
    jobs: int = 1,
    progress: bool | Progress = False,
    page: Path | None = None,
    sheet: Path | None = None,
    cluster: str | None = None,
) -> list[SceneResult]:
    """Do the work on every scene of a folder, unless it is finished, and write the table of results
    to the folder ``target``. Inside of :func:`~pointsplat_ns.system.outputs.outputs_claimed`.

    Args:
        folder, target, jobs, progress, cluster: as for :func:`compact_folder`.
        work: pickled for other processes.
        target_format: suffix of all results; by default the format of each scene.
        page, sheet: as ``html`` and ``picture`` of :func:`compact_folder`.

    Raises:
        SceneError: as :func:`compact_folder`.
    """
    check_jobs(jobs, cluster)
    for shown, end in ((page, ".html"), (sheet, ".png")):
        if shown is not None:
            need_suffix(shown, end)
            need_new(shown, work.force or (target / FOLDER_FILES.scenes).exists())
    if os.path.realpath(folder) == os.path.realpath(target):
        raise SceneError(
            f"{target}: contains the scenes themselves; name another folder for the results"
        )
    tasks = [
        Task(name, path, target / f"{name}{target_format or format_like(path).suffix}")
        for name, path in find_scenes(folder).items()
    ]
    results: dict[str, SceneResult] = {}
    with connected(cluster) as machines:
        if machines is not None:
            work = work.started_in(Path.cwd())
        if not work.force:
            claim(target)
        _describe(target, work.record, work.force)
        shared = target.absolute() / FOLDER_FILES.scenes
        try:
            with progress_bar(progress) as report, Workers(work, jobs, machines, shared) as workers:
                report(work.label, 0.0)
                for task, result in _results(workers, tasks):
                    results[task.name] = result
                    report(work.label, len(results) / len(tasks))
                    if result.status == "failed":
                        logger.warning("%s failed: %s", result.name, result.error)
        finally:  # also after an interruption
            for task in tasks:
                # Workers of a cluster may still be writing theirs.
                if task.name not in results and machines is None:
                    task.remove_parts()
            rows = [results.get(task.name) or _known(task, _read_record(task)) for task in tasks]
            write_csv([dataclasses.asdict(row) for row in rows], target / FOLDER_FILES.scenes_table)
            if page is not None:
                write_gallery(page, folder.resolve().name, rows)
            if sheet is not None:
                write_sheet(sheet, rows)
    return rows


def output_folder(folder: Path, done: str = "compact") -> Path:
    """The default output folder, beside a folder: ``scenes_compact`` for ``scenes``."""
    place = Path(os.path.abspath(folder))
    return unnamed(place.with_name(f"{place.name}_{done}"))


@functools.cache
def _loaded(path: str | Path, by: str | None, sha256: str = "") -> TrainedRefiner:
    """A refiner, loaded once in each process. Workers of a cluster outlive files: ``sha256`` tells
    another content of the same path."""
    return load_refiner(path, by=by)


@dataclass(frozen=True)
class Task:
    """A scene to work on, and the file to write."""

    name: str
    source: Path
    output: Path
    paths: tuple[str, str] | None = None
    """Both as the user's command names them, if these are others."""

    def result(
        self, status: Literal["done", "done before", "failed", "open"], **facts: Any
    ) -> SceneResult:
        source, output = self.paths or (str(self.source), str(self.output))
        return SceneResult(name=self.name, source=source, output=output, status=status, **facts)

    def started_in(self, folder: Path) -> Task:
        """The task where the current folder is another one than that of the command."""
        return dataclasses.replace(
            self,
            source=folder / self.source,
            output=folder / self.output,
            paths=(str(self.source), str(self.output)),
        )

    def remove_parts(self) -> None:
        """Remove what a process left that died while writing the result."""
        for part in self.output.parent.glob(f".{glob.escape(self.output.name)}*.part"):
            part.unlink(missing_ok=True)

    @property
    def folder(self) -> Path:
        """The folder of all results."""
        return self.output.parents[self.name.count("/")]

    @property
    def record(self) -> Path:
        """File with the figures and hashes of the result."""
        return self.output.with_name(f"{self.output.name}.json")


def _results(
    workers: Workers[Task, SceneResult], tasks: list[Task]
) -> Iterator[tuple[Task, SceneResult]]:
    """Results of the workers. A scene of which workers of a cluster die has failed."""
    try:
        yield from workers.results(tasks)
    except LostWorkError as error:
        for task, reason in error.reasons.items():
            yield task, task.result("failed", error=reason)


def _describe(output: Path, options: Mapping[str, Any], force: bool) -> None:
    """Write the options beside the results. Raises SceneError if the output is not a folder, or
    contains results of other options."""
    need_folder(output)
    path = output / FOLDER_FILES.scenes
    text = json_text(options) + "\n"
    try:
        other = path.exists() and not path.is_symlink() and read_text(path) != text
    except (OSError, ValueError) as error:
        raise SceneError(
            f"{path}: cannot be read ({one_line(error)}); name another folder for the results"
        ) from error
    if other and not force:
        raise SceneError(
            f"{output}: contains results of other options, see {path.name}; name another folder, or "
            "overwrite them with --force"
        )
    write_json(options, path)


@dataclass(frozen=True, eq=False)
class Made:
    """A scene of a folder and its result, which is not written yet."""

    dense: Gaussians
    scene: Gaussians
    kind: Format
    """Format of the result."""
    note: str = ""
    """Note on the result; empty if there is none."""
    psnr_of: Callable[[Gaussians], float] | None = None
    """PSNR of the result as it is read from its file, dB; None if it is not compared."""


@dataclass(frozen=True)
class FolderWork:
    """Work on the scenes of a folder, one after the other. Pickled for other processes."""

    record: Mapping[str, Any]  # options as recorded, to recognise results of other options
    drawn: bool  # whether to draw each scene before and after
    force: bool
    label: ClassVar[str]
    """Name of the work, beside its progress."""
    start: Path | None = dataclasses.field(default=None, kw_only=True)
    """Current folder of the command, if that of a process is another."""

    def started_in(self, folder: Path) -> FolderWork:
        """The same work, for processes whose current folder is another."""
        return dataclasses.replace(self, start=folder)

    def make(self, task: Task) -> Made:
        """The result of a scene."""
        raise NotImplementedError

    def draw(self, task: Task, before: Gaussians, after: Gaussians) -> None:
        """Draw a scene and its result to a file."""

    def __call__(self, task: Task) -> SceneResult:
        """The result of a scene. On an error its status is ``failed``, and no file is left."""
        task = task if self.start is None else task.started_in(self.start)
        start = time.perf_counter()
        try:
            for part in source_parts(task.source):
                require_memory(part, part.stat().st_size)  # before hashing a sparse file for hours
            need_no_links(task.folder, task.output)
            source = source_file(task.source)
            text = json.dumps([source.sha256, self.record], sort_keys=True)
            key = hashlib.sha256(text.encode()).hexdigest()
            record = _read_record(task)
            whole = (
                record is not None
                and is_own_file(task.output)
                and content_hash(task.output) == record["sha256"]
            )
            if not whole and os.path.lexists(task.output) and not self.force:
                raise SceneError(
                    f"{task.output}: exists already, but not as an earlier call wrote it; name another "
                    "folder, or overwrite it with --force"
                )
            if record is None or not whole or record["key"] != key:
                return self._written(task, source.bytes, key, start)
            if self.drawn and not is_own_file(pair_of(task.output)):
                self.draw(task, read_scene(task.source), read_scene(task.output))
            return _known(task, record)
        except Exception as error:  # one scene must not stop the others
            expected = isinstance(error, (PointSplatError, OSError))
            kind = "" if expected else f"{type(error).__name__}: "
            return task.result(
                "failed",
                seconds=time.perf_counter() - start,
                error=kind + one_line(error, limit=1000),
            )

    def _written(self, task: Task, source_bytes: int, key: str, start: float) -> SceneResult:
        """Write a result and its record. A process killed in between leaves only the record, so the
        scene counts as open."""
        task.remove_parts()
        new = not self.force and not os.path.lexists(task.output)
        made = self.make(task)
        with replacing(task.output, named=False, new=new) as part:
            save_as(made.kind, made.scene, part, name=task.output)
            written = read_back(made.scene, part, made.kind) if made.psnr_of else made.scene
            psnr = made.psnr_of(written) if made.psnr_of else math.inf
            done = task.result(
                "done",
                before=len(made.dense),
                after=len(made.scene),
                megabytes_before=source_bytes / 1e6,
                megabytes=part.stat().st_size / 1e6,
                psnr=psnr if math.isfinite(psnr) else None,
                seconds=time.perf_counter() - start,
                note=made.note,
            )
            # Old files must not remain beside the new record.
            for old in (pair_of(task.output), *(() if new else (task.output,))):
                old.unlink(missing_ok=True)
            proofs = {"key": key, "options": self.record, "sha256": content_hash(part)}
            write_json({**dataclasses.asdict(done), **proofs}, task.record)
        if self.drawn:
            self.draw(task, made.dense, written)
        return done


@dataclass(frozen=True)
class _Compacting(FolderWork):
    """Compacts the scenes of a folder."""

    options: CompactOptions
    refiner: str | Path | None  # loaded by each process
    label: ClassVar[str] = "compact"

    def started_in(self, folder: Path) -> _Compacting:
        data, refiner = self.options.data, self.refiner
        return dataclasses.replace(
            self,
            options=dataclasses.replace(self.options, data=None if data is None else folder / data),
            refiner=refiner if refiner is None or str(refiner) == SHIPPED else folder / refiner,
            start=folder,
        )

    def make(self, task: Task) -> Made:
        dense = read_scene(task.source)
        kind = self.options.format_of(task.output.name)
        options = dataclasses.replace(self.options, target_format=kind.suffix)
        views = ViewProvider(dense, run=task.source, data=options.data, resolution=options.size)
        trained = None
        if self.refiner is not None:
            trained = _loaded(self.refiner, options.by, self.record["refiner"])
        compact = compact_to_quality if options.searched else compact_scene
        made = compact(dense, options, views, refiner=trained)
        if made.interrupted:
            raise KeyboardInterrupt  # Ctrl-C ends the whole command, not only this scene
        scene = made.scene
        same = scene.sh_degree == dense.sh_degree and len(scene) == len(dense)
        same = same and all(map(torch.equal, scene.tensors(), dense.tensors()))
        differs = not same or kind.suffix != ".ply"
        judge = (made.judge or judge_of(dense, views)) if differs else None
        note = "unchanged" if same else f"no dataset: {views.missing}" * bool(views.missing)
        return Made(
            dense=dense,
            scene=scene,
            kind=kind,
            note=note,
            psnr_of=lambda written: math.inf if judge is None else judge.psnr(written)[0],
        )

    def draw(self, task: Task, before: Gaussians, after: Gaussians) -> None:
        """Draw a scene and its result to a file, unless the scene is invisible."""
        after = after if after.offset is None else after.at_offset(before.offset)
        views = ViewProvider(before, run=task.source, data=self.options.data)
        with suppress(DataError):
            draw_pair(before, after, views.known(VIEW_COUNTS.opening), pair_of(task.output))


def _read_record(task: Task) -> dict[str, Any] | None:
    """The record of a result; None if it is missing or damaged."""
    if not is_own_file(task.record):
        return None
    try:
        record = json.loads(read_text(task.record))
        texts = all(isinstance(record[name], str) for name in ("key", "sha256", "note"))
        numbers = all(record[name] is None or 0 <= record[name] < 1e18 for name in FIGURES)
    except (OSError, ValueError, RecursionError, KeyError, TypeError):
        return None
    return record if texts and numbers else None


def _known(task: Task, record: dict[str, Any] | None) -> SceneResult:
    """The result in a record; without a record an open result."""
    if record is None:
        return task.result("open")
    return task.result("done before", **{name: record[name] for name in (*FIGURES, "note")})
