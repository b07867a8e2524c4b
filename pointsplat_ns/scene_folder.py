"""Runs a command on every scene of a folder, and writes a table of the results.

The record of a result ``room.ply`` is ``room.ply.json``. A result is finished if its record has the hashes of the input
file with the options, and of the result itself. While a process works on the scene it holds the lock ``.room.ply.lock``
and writes to the folder ``.room.ply.part``.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import math
import os
import shutil
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pointsplat_ns.compression.quality import Judge, quality_line, read_back
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.discovery import FOLDER_FILES, find_scenes
from pointsplat_ns.io.files import (
    content_hash,
    json_text,
    logger,
    one_line,
    read_text,
    replacing,
    require_memory,
    write_csv,
    write_json,
)
from pointsplat_ns.io.formats import format_like, format_to_read, format_to_write
from pointsplat_ns.io.scene import read_scene, save_as, source_file, source_parts
from pointsplat_ns.pages.gallery import pair_of
from pointsplat_ns.system.claims import claim
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.workers import WorkerKilled, Workers, check_jobs

Status = Literal["done", "done before", "failed", "open"]

FIGURES = ("before", "after", "megabytes_before", "megabytes", "psnr", "seconds")
"""Numbers of a result in its record."""

_Facts = Mapping[str, Any]
CommandOptions = Mapping[str, str | float | bool | None]
"""The options that a result depends on."""


@dataclass(frozen=True)
class SceneResult:
    """The result of one of many scenes.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::100], f"{folder}/rooms/hall.ply")
        ...     [result] = ps.compact_folder(f"{folder}/rooms", keep="50%", effort="instant")
        >>> result.name, result.status, result.before, result.after
        ('hall', 'done', 629, 315)
    """

    name: str
    """Path of the scene below its folder, without a suffix."""
    source: str
    """Path of the file or run that was read."""
    output: str
    """Path of the file that was written."""
    status: Status  # ``done before``: by an earlier call or another process. ``open``: not finished
    before: int | None = None
    """Gaussians of the scene."""
    after: int | None = None
    """Gaussians of the result."""
    megabytes_before: float | None = None
    """Size of the scene's file, 10^6 bytes."""
    megabytes: float | None = None
    """Size of the result, 10^6 bytes."""
    psnr: float | None = None
    """PSNR against the scene's own renders, dB; None if nothing was compared or they are equal."""
    seconds: float | None = None
    """Duration."""
    error: str = ""
    """The error in one line; empty if there was none."""
    note: str = ""
    """A remark on the result; empty if there is none."""

    def __str__(self) -> str:
        """What users read of a result."""
        return "; ".join(filter(None, ("" if self.psnr is None else quality_line(self.psnr, None), self.note)))


Show = Callable[[Sequence[SceneResult]], None]


@dataclass(frozen=True)
class SmallerScene:
    """A smaller scene, and figures for the table."""

    scene: Gaussians
    judge: Judge | None = None
    """Judges the written file; None if nothing is compared."""
    note: str = ""
    """A remark for the table."""
    same: bool = False
    """Whether this is the dense scene itself, whose file is copied if its format stays."""


@dataclass(frozen=True)
class Command:
    """A command to run on every scene. Other processes get it pickled: functions are those of modules, or partial."""

    name: str
    make: Callable[[Gaussians, Path], SmallerScene]
    """From a dense scene and its path to a smaller one."""
    options: CommandOptions
    """All options that ``make`` depends on."""
    suffix: str | None = None
    """Suffix of the results; None for the format of each scene."""
    draw: Callable[[Path, Path, Path], None] | None = None
    """Draws a scene and its result to a picture file, from their paths; None for no pictures."""


@dataclass(frozen=True)
class SceneTask:
    """A scene to work on, and the file to write."""

    name: str
    source: Path
    output: Path

    def result(self, status: Status, **facts: Any) -> SceneResult:
        """A result of this scene."""
        return SceneResult(self.name, str(self.source), str(self.output), status, **facts)

    @property
    def record(self) -> Path:
        """The file with the figures and hashes of the result."""
        return self.output.with_name(f"{self.output.name}.json")

    @property
    def lock(self) -> Path:
        """The file that a process locks while it works on the scene."""
        return self.output.with_name(f".{self.output.name}.lock")

    @property
    def unfinished(self) -> Path:
        """The folder for unfinished files, which whoever holds the lock may remove."""
        return self.output.with_name(f".{self.output.name}.part")


def run_on_folder(
    folder: Path,
    output: Path,
    command: Command,
    jobs: int = 1,
    force: bool = False,
    progress: bool | Progress = False,
    show: Show | None = None,
) -> list[SceneResult]:
    """Run a command on every scene of a folder, and write the results to another. ``show`` is called at the end, also
    after an interruption. Other arguments, results and errors: :func:`~pointsplat_ns.folders.compact_folder`."""
    check_jobs(jobs)
    if os.path.realpath(folder) == os.path.realpath(output):
        raise SceneError(f"{output}: holds the scenes themselves; name another folder for the results")
    tasks = [
        SceneTask(scene.name, scene.path, output / f"{scene.name}{command.suffix or format_like(scene.path).suffix}")
        for scene in find_scenes(folder)
    ]
    _check_and_describe(output, command, force)
    results: dict[str, SceneResult] = {}
    try:
        with progress_bar(progress) as report, Workers(functools.partial(_make_result, command, force), jobs) as work:
            report(command.name, 0.0)
            for wait in (False, True):  # at last for those that another command works on
                left = [(task, wait) for task in tasks if task.name not in results]
                for (task, _), result in work.results(left):
                    result = task.result("failed", error=str(result)) if isinstance(result, WorkerKilled) else result
                    if result is None:
                        continue
                    results[task.name] = result
                    report(command.name, len(results) / len(tasks))
                    if result.status == "failed":
                        logger.warning("%s failed: %s", result.name, result.error)
    finally:  # also after an interruption
        for task in tasks:
            if task.name not in results or results[task.name].status == "failed":
                _clean(task)
        _write_table(output, tasks, results, show)
    return [results[task.name] for task in tasks]


def output_folder(folder: Path, suffix: str) -> Path:
    """The default output folder, beside a folder: ``scenes_compact`` for ``scenes``."""
    place = Path(os.path.abspath(folder))
    return place.with_name(f"{place.name}_{suffix}")


def _check_and_describe(output: Path, command: Command, force: bool) -> None:
    """Write the description of the results. Raises SceneError if the output is no folder, or holds results of another
    command or other options."""
    if output.exists() and not output.is_dir():
        raise SceneError(f"{output}: is a file; expected the name of a folder")
    path = output / FOLDER_FILES.scenes
    description = {"format": "pointsplat-scenes", "command": command.name, "options": dict(command.options)}
    try:
        with claim(output / FOLDER_FILES.scenes_lock, wait=True):
            try:
                known = json.loads(read_text(path)) if path.exists() else None
            except (ValueError, RecursionError):
                known = "damaged"
            if known is not None and known != description and not force:
                raise SceneError(
                    f"{output}: holds results of {_difference(known, description)}; name another folder, or overwrite "
                    "them with --force"
                )
            if known != description:
                write_json(description, path)
    except OSError as error:
        raise SceneError(f"{output}: cannot be used ({error.strerror or error})") from error


def _difference(known: Any, wanted: Mapping[str, Any]) -> str:
    """How a description of results differs from the wanted one."""
    before = known.get("options") if isinstance(known, dict) else None
    if not isinstance(before, dict):
        return f"unknown options, as {FOLDER_FILES.scenes} is damaged"
    if known.get("command") != wanted["command"]:
        return f"the command {known.get('command')}"
    now = wanted["options"]
    names = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    return "other options (" + ", ".join(f"{name}: {before.get(name)}, now {now.get(name)}" for name in names) + ")"


def _make_result(command: Command, force: bool, given: tuple[SceneTask, bool]) -> SceneResult | None:
    """Make the result of a task, unless it is finished. While another process works on the scene, wait for it if told
    so, else give None. An error gives a result with the status ``failed``, and leaves no file."""
    (task, wait), start = given, time.perf_counter()
    try:
        with claim(task.lock, wait) as held:
            if not held:
                return None
            shutil.rmtree(task.unfinished, ignore_errors=True)  # of a killed process
            for part in source_parts(task.source):
                require_memory(part, part.stat().st_size)  # before hours of hashing a sparse file
            source = source_file(task.source)
            text = json.dumps([source.sha256, dict(command.options)], sort_keys=True)
            key = hashlib.sha256(text.encode()).hexdigest()
            record = _read_record(task)
            whole = record is not None and task.output.is_file() and content_hash(task.output) == record["sha256"]
            if not whole and os.path.lexists(task.output) and not force:
                raise SceneError(
                    f"{task.output}: exists already, and was not made by an earlier call or was changed since; "
                    "name another folder, or overwrite it with --force"
                )
            if record is not None and whole and record["key"] == key:
                result = _result_in(task, record)
            else:
                dense = read_scene(task.source)
                made = command.make(dense, task.source)
                facts = {"before": len(dense), "megabytes_before": source.bytes / 1e6}
                result = _write(task, facts, made, {"key": key, "options": dict(command.options)}, start)
            if command.draw is not None and not pair_of(task.output).exists():
                command.draw(task.source, task.output, pair_of(task.output))
            task.lock.unlink(missing_ok=True)  # the next process to get the lock finds the scene finished
            return result
    except Exception as error:  # one scene must not stop the others
        kind = "" if isinstance(error, (PointSplatError, OSError)) else f"{type(error).__name__}: "
        logger.debug("%s", task.source, exc_info=True)
        error_text = kind + one_line(error, limit=1000)  # with the paths in it
        return task.result("failed", seconds=time.perf_counter() - start, error=error_text)


def _write(task: SceneTask, known: _Facts, made: SmallerScene, proofs: _Facts, start: float) -> SceneResult:
    """Write a result and its record. A process killed in between leaves the record alone: the scene is unfinished."""
    kind, unfinished = format_to_write(task.output), task.unfinished
    unfinished.mkdir()
    with replacing(task.output, folder=unfinished) as part:
        if made.same and task.source.is_file() and format_to_read(task.source) is kind:
            shutil.copyfile(task.source, part)
        else:
            save_as(kind, made.scene, part, name=task.output)
        psnr = math.inf if made.judge is None else made.judge.psnr(read_back(made.scene, part, kind))[0]
        done = task.result(
            "done",
            **known,
            after=len(made.scene),
            megabytes=part.stat().st_size / 1e6,
            psnr=psnr if math.isfinite(psnr) else None,
            seconds=time.perf_counter() - start,
            note=made.note,
        )
        for old in (task.output, pair_of(task.output)):  # must not stand beside the new record
            old.unlink(missing_ok=True)
        facts = {name: value for name, value in dataclasses.asdict(done).items() if name not in ("name", "output")}
        with replacing(task.record, folder=unfinished, named=False) as record:
            record.write_text(json_text({**facts, **proofs, "sha256": content_hash(part)}) + "\n", encoding="utf-8")
    unfinished.rmdir()
    return done


def _clean(task: SceneTask) -> None:
    """Remove the unfinished files and the lock of a process that has ended, unless another works on the scene."""
    if not task.lock.exists():
        return
    with suppress(OSError), claim(task.lock) as held:
        if held:
            shutil.rmtree(task.unfinished, ignore_errors=True)
            task.lock.unlink(missing_ok=True)


def _read_record(task: SceneTask) -> dict[str, Any] | None:
    """The record of a result; None if it is missing or damaged."""
    try:
        record = json.loads(read_text(task.record))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(record, dict):
        return None
    texts = all(isinstance(record.get(name), str) for name in ("key", "sha256", "note"))
    figures = [record.get(name) for name in FIGURES]
    numbers = all(value is None or (isinstance(value, (int, float)) and abs(value) < 1e18) for value in figures)
    return record if texts and numbers else None


def _result_in(task: SceneTask, record: Mapping[str, Any]) -> SceneResult:
    """The result in a record."""
    return task.result("done before", **{name: record.get(name) for name in (*FIGURES, "note")})


def _write_table(
    output: Path, tasks: Sequence[SceneTask], results: Mapping[str, SceneResult], show: Show | None
) -> None:
    """Write the table of all scenes, and show them. Results that an interruption left out come from their records."""

    def row(task: SceneTask) -> SceneResult:
        record = _read_record(task)
        return task.result("open") if record is None else _result_in(task, record)

    with claim(output / FOLDER_FILES.scenes_lock, wait=True):  # so the last process to write has read all records
        rows = [results.get(task.name) or row(task) for task in tasks]
        write_csv([dataclasses.asdict(row) for row in rows], output / FOLDER_FILES.scenes_table)
        if show is not None:
            show(rows)
