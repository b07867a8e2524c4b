"""One scene of a folder: the lock of the process that works on it, its result, and the record of the result.

The record of a result ``room.ply`` is ``room.ply.json``. A result is finished if its record has the hashes of the input
file, of the options and of the result itself.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
import os
import re
import shutil
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import content_hash, logger, one_line, read_text, replacing
from pointsplat_ns.io.formats import format_to_read, format_to_write
from pointsplat_ns.io.scene import save_as
from pointsplat_ns.io.source import source_file
from pointsplat_ns.system.claims import claim

Status = Literal["done", "done before", "failed", "open"]

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
    status: Status
    """``done before``: by an earlier call, or by another process. ``open``: not tried yet, or in another shard."""
    before: int | None = None
    """Gaussians of the scene."""
    after: int | None = None
    """Gaussians of the result."""
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


@dataclass(frozen=True)
class SmallerScene:
    """A smaller scene, and figures for the table."""

    scene: Gaussians
    before: int
    """Gaussians of the dense scene."""
    psnr: float | None
    """PSNR against the dense scene's renders, dB; None if nothing was compared."""
    note: str = ""
    """A remark for the table."""
    same: bool = False
    """Whether this is the dense scene itself, whose file is copied if its format stays."""


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


def make_result(
    task: SceneTask, make: Callable[[Path], SmallerScene], options: CommandOptions, force: bool = False
) -> SceneResult | None:
    """Make the result of a scene, unless it is finished; None if another process works on it.

    An error gives a result with the status ``failed``. It leaves no file but its record. ``options`` are all options
    that ``make``, from the path of the scene to the smaller scene, depends on. With ``force``, a file of other origin,
    or a changed result, is overwritten.
    """
    start = time.perf_counter()
    try:
        with claim(task.lock) as claimed:
            if not claimed:
                return None
            remove_unfinished(task)
            key = _key(task, options)
            result = _finished(task, key)
            if result is None:
                _check_overwriting(task, force)
                result = _write(task, make(task.source), key, options, start)
            task.lock.unlink(missing_ok=True)  # the next process to get the lock finds the scene finished
            return result
    except Exception as error:  # one scene must not stop the others
        kind = "" if isinstance(error, (PointSplatError, OSError)) else f"{type(error).__name__}: "
        text = one_line(error, limit=1000)  # with the paths in it
        failed = task.result("failed", seconds=time.perf_counter() - start, error=kind + text)
        logger.debug("%s", task.source, exc_info=True)
        note_failure(task, failed)
        return failed


def remove_unfinished(task: SceneTask) -> None:
    """Remove the partial files of a killed process. The caller must hold the task's lock."""
    # As :func:`~pointsplat_ns.io.files.replacing` names them; a result is written within one call by another.
    pattern = re.compile(rf"\.{{1,2}}{re.escape(task.output.name)}(\.json)?(\.\d+(-[0-9a-f]+)?\.part){{1,2}}")
    with os.scandir(task.output.parent) as entries:
        parts = [entry.path for entry in entries if pattern.fullmatch(entry.name)]
    for part in parts:
        Path(part).unlink(missing_ok=True)


def note_failure(task: SceneTask, failed: SceneResult) -> None:
    """Write the record of a failed scene, for the tables of other processes. An earlier result keeps its record."""
    with suppress(SceneError):  # the folder itself may have failed
        if not task.output.exists():
            _write_record(task, failed, {})


def known_result(task: SceneTask) -> SceneResult:
    """The result in a scene's record, without a check of its files."""
    record = _read_record(task)
    if record is None:
        return task.result("open")
    status: Status = "failed" if record["status"] == "failed" else "done before"
    facts = {field.name: record.get(field.name) for field in dataclasses.fields(SceneResult)[4:]}
    return task.result(status, **facts)


def _key(task: SceneTask, options: CommandOptions) -> str:
    """Hash of the input file and the options."""
    text = json.dumps([source_file(task.source).sha256, dict(options)], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _finished(task: SceneTask, key: str) -> SceneResult | None:
    """The result of an earlier call, if it is unchanged and of the same scene and options; else None."""
    record = _read_record(task)
    if record is None or record.get("key") != key or not _as_written(task, record):
        return None
    return known_result(task)


def _as_written(task: SceneTask, record: Mapping[str, Any]) -> bool:
    """Whether a result exists and is unchanged."""
    return task.output.is_file() and content_hash(task.output) == record.get("sha256")


def _check_overwriting(task: SceneTask, force: bool) -> None:
    """Refuse to replace a file, unless it is an unchanged result of this module."""
    if force or not os.path.lexists(task.output):
        return
    record = _read_record(task)
    if record is None or not _as_written(task, record):
        raise SceneError(
            f"{task.output}: exists already, and was not made by an earlier call or was changed since; name another "
            "folder, or overwrite it with --force"
        )


def _write(task: SceneTask, made: SmallerScene, key: str, options: CommandOptions, start: float) -> SceneResult:
    """Write a result and its record. A process killed in between leaves the record alone: the scene is unfinished."""
    with replacing(task.output) as part:
        kind = format_to_write(task.output)
        if made.same and task.source.is_file() and format_to_read(task.source) is kind:
            shutil.copyfile(task.source, part)
        else:
            save_as(kind, made.scene, part, name=task.output)
        done = task.result(
            "done",
            before=made.before,
            after=len(made.scene),
            megabytes=part.stat().st_size / 1e6,
            psnr=made.psnr if made.psnr is not None and math.isfinite(made.psnr) else None,
            seconds=time.perf_counter() - start,
            note=made.note,
        )
        task.output.unlink(missing_ok=True)  # an old scene must not stand beside the new record
        _write_record(task, done, {"key": key, "sha256": content_hash(part), "options": dict(options)})
    return done


def _write_record(task: SceneTask, result: SceneResult, proofs: Mapping[str, Any]) -> None:
    facts = {name: value for name, value in dataclasses.asdict(result).items() if name not in ("name", "output")}
    with replacing(task.record, named=False) as part:
        part.write_text(json.dumps({**facts, **proofs}, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _is_number(value: Any, kind: type) -> bool:
    return value is None or (isinstance(value, (int, float)) and isinstance(value, (kind, int)) and abs(value) < 1e18)


def _read_record(task: SceneTask) -> dict[str, Any] | None:
    """The content of a scene's record; None if it is missing or damaged."""
    try:
        record = json.loads(read_text(task.record))
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or record.get("status") not in ("done", "failed"):
        return None
    kinds = {"before": int, "after": int, "megabytes": float, "psnr": float, "seconds": float}
    numbers = all(_is_number(record.get(name), kind) for name, kind in kinds.items())
    texts = all(isinstance(record.get(name), str) for name in ("error", "note"))
    return record if numbers and texts else None
