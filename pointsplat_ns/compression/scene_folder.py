"""Runs a command on every scene of a folder, in shards and in several processes, and writes a table of the results."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import re
from collections.abc import Callable, Generator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.compression.scene_task import (
    CommandOptions,
    SceneResult,
    SceneTask,
    SmallerScene,
    known_result,
    make_result,
    note_failure,
    remove_unfinished,
)
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.io.csv_tables import write_csv
from pointsplat_ns.io.discovery import FOLDER_FILES, find_scenes
from pointsplat_ns.io.files import logger, read_text, replacing
from pointsplat_ns.io.formats import format_like
from pointsplat_ns.system.claims import claim
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.workers import in_processes, in_turn

SCENES_FORMAT = "pointsplat-scenes"


@dataclass(frozen=True)
class Shard:
    """One of several parts of a list, as ``2/5``: the second of five.

    Raises:
        DataError: if the index is not in 1..count.

    Example:
        >>> Shard.of("2/3").part(list("abcdefg"))
        ['b', 'e']
    """

    index: int = 1
    """From 1 on."""
    count: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.index <= self.count:
            raise DataError(f"shard {self.index}/{self.count}; expected 1/{self.count} to {self.count}/{self.count}")

    @classmethod
    def of(cls, text: str) -> Shard:
        """The shard of a text such as ``2/5``."""
        numbers = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
        if numbers is None:
            raise DataError(f"shard {text!r}; expected which one of how many, such as 1/4")
        return cls(int(numbers[1]), int(numbers[2]))

    def within(self, rank: int, world_size: int) -> Shard:
        """The part of this shard for one of several processes, by its rank from 0 on."""
        return Shard((self.index - 1) * world_size + rank + 1, self.count * world_size)

    def part(self, items: Sequence) -> list:
        """The items of this part: every ``count``-th one."""
        return list(items[self.index - 1 :: self.count])


@dataclass(frozen=True)
class Command:
    """A command to run on every scene. It is pickled for other processes, so ``make`` has to be a function of a module,
    or a partial of one."""

    name: str
    make: Callable[[Path], SmallerScene]
    options: CommandOptions
    """All options that ``make`` depends on."""
    suffix: str | None = None
    """Suffix of the results; None for the format of each scene."""

    @property
    def description(self) -> dict[str, object]:
        """The content of the file that describes the results of a folder."""
        return {"format": SCENES_FORMAT, "command": self.name, "options": dict(self.options)}


def run_on_folder(
    folder: Path,
    output: Path,
    command: Command,
    jobs: int = 1,
    shard: Shard = Shard(),
    force: bool = False,
    progress: Progress = silent,
) -> list[SceneResult]:
    """Run a command on every scene of a folder, and write the results to another folder.

    Finished results are kept, so the next call continues an interrupted call. Several processes may work on the same
    folders at the same time; one of them claims each scene.

    Args:
        folder: searched by :func:`~pointsplat_ns.io.discovery.find_scenes`.
        output: folder for ``NAME.ply``, or another format that a scene is in, its record ``NAME.ply.json``, and the
            table ``scenes.csv``.
        command: the command.
        jobs: number of processes; 1 uses the calling process.
        shard: the part of the scenes to work on.
        force: overwrite files of other origin or with other options.

    Returns:
        The results of the shard's scenes, in the order of their names.

    Raises:
        DataError: if ``jobs`` is not positive.
        SceneError: if there are no scenes, or the output folder holds other results.
    """
    if jobs < 1:
        raise DataError(f"jobs is {jobs}; expected 1 or more")
    everything = _tasks(folder, output, command.suffix)
    tasks = shard.part(everything)
    _check_and_describe(output, command, force)
    results: dict[str, SceneResult] = {}
    work = functools.partial(make_result, make=command.make, options=command.options, force=force)
    try:
        with contextlib.closing(_results(work, tasks, jobs)) as finished:
            progress(command.name, 0.0)
            for result in finished:
                results[result.name] = result
                progress(command.name, len(results) / len(tasks))
                if result.status == "failed":
                    logger.warning("%s failed: %s", result.name, result.error)
    finally:  # also after an interruption
        _write_table(output, everything, results)
    return [results[task.name] for task in tasks]


def output_folder(folder: Path, suffix: str) -> Path:
    """The default output folder, beside a folder: ``scenes_compact`` for ``scenes``."""
    place = Path(os.path.abspath(folder))
    return place.with_name(f"{place.name}_{suffix}")


def _tasks(folder: Path, output: Path, suffix: str | None) -> list[SceneTask]:
    if os.path.realpath(folder) == os.path.realpath(output):
        raise SceneError(f"{output}: holds the scenes themselves; name another folder for the results")
    return [
        SceneTask(scene.name, scene.path, output / f"{scene.name}{suffix or format_like(scene.path).suffix}")
        for scene in find_scenes(folder)
    ]


def _results(
    work: Callable[[SceneTask], SceneResult | None], tasks: Sequence[SceneTask], jobs: int
) -> Generator[SceneResult, None, None]:
    if jobs == 1:
        return in_turn(work, tasks)
    # Slow imports are made once, before processes are forked.
    slow = ("pointsplat_ns.folders", "kornia.metrics", "plyfile", "safetensors.torch", "scipy.spatial")
    return in_processes(work, tasks, jobs, _given_up, _clear, preload=slow)


def _given_up(task: SceneTask, how: str) -> SceneResult:
    """The result of a scene whose processes were killed repeatedly."""
    _clear(task)
    failed = task.result("failed", error=f"every process that worked on it ended early; the last {how}")
    note_failure(task, failed)
    return failed


def _clear(task: SceneTask) -> None:
    """Remove the partial files of a killed process, unless another process works on the scene."""
    with claim(task.lock) as claimed:
        if claimed:
            remove_unfinished(task)


def _check_and_describe(output: Path, command: Command, force: bool) -> None:
    """Write the description of the results. Raises SceneError if the output is no folder, or holds results of another
    command or other options."""
    path, description = output / FOLDER_FILES.scenes, command.description
    if output.exists() and not output.is_dir():
        raise SceneError(f"{output}: is a file; expected the name of a folder")
    try:
        with claim(output / FOLDER_FILES.scenes_lock, wait=True):
            known = _description(path)
            if known is not None and known != description and not force:
                raise SceneError(
                    f"{output}: holds results of {_differences(known, description)}; name another folder, or overwrite "
                    "them with --force"
                )
            if known != description:
                with replacing(path, named=False) as part:
                    part.write_text(json.dumps(description, indent=2) + "\n", encoding="utf-8")
    except OSError as error:
        raise SceneError(f"{output}: cannot be used ({error.strerror or error})") from error


def _description(path: Path) -> dict | None:
    """The description of the results in a folder; None if there is none."""
    try:
        known = json.loads(read_text(path))
    except FileNotFoundError:
        return None
    except (ValueError, RecursionError):
        known = None
    if (
        not isinstance(known, dict)
        or known.get("format") != SCENES_FORMAT
        or not isinstance(known.get("options"), dict)
    ):
        raise SceneError(f"{path}: damaged; remove it, or name another folder")
    return known


def _differences(known: Mapping, wanted: Mapping) -> str:
    if known.get("command") != wanted["command"]:
        return f"the command {known.get('command')}"
    before, now = known["options"], wanted["options"]
    names = sorted(name for name in {*before, *now} if before.get(name) != now.get(name))
    return "other options (" + ", ".join(f"{name}: {before.get(name)}, now {now.get(name)}" for name in names) + ")"


def _write_table(output: Path, everything: Sequence[SceneTask], results: Mapping[str, SceneResult]) -> None:
    """Write the table of all scenes. Scenes of other shards are taken from their records."""
    with claim(output / FOLDER_FILES.scenes_lock, wait=True):  # so the last process to write has read all records
        rows = [results.get(task.name) or known_result(task) for task in everything]
        write_csv([dataclasses.asdict(row) for row in rows], output / FOLDER_FILES.scenes_table)
