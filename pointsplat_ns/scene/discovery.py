"""Finds the scenes below a folder: trained runs, PLY files, or both."""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Literal

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.formats import READABLE, TILESET, format_named, format_to_read
from pointsplat_ns.scene.formats.gltf import has_gaussians, read_gltf
from pointsplat_ns.scene.inert_yaml import read_config
from pointsplat_ns.scene.ply import read_ply
from pointsplat_ns.scene.ply_header import read_header
from pointsplat_ns.scene.reading import is_folder_of_scenes, is_scene_file
from pointsplat_ns.scene.runs import RUN_FILES, Run, is_refiner_method, open_run, scene_name
from pointsplat_ns.system.files import file_stem, logger
from pointsplat_ns.system.opening import open_regular

Supervision = Literal["auto", "photos", "dense"]
"""Training targets: the run's photos, or renders of the scene before pruning."""


@dataclass(frozen=True)
class FolderFiles:
    """Names of the files that commands write into folders."""

    scenes: str = "pointsplat-scenes.json"
    """Command and options shared by all results in a folder of scenes."""
    scenes_table: str = "scenes.csv"
    levels: str = "lod.json"
    """Manifest of levels of detail."""


FOLDER_FILES = FolderFiles()


def find_scenes(folder: Path | str) -> dict[str, Path]:
    """All scenes below a folder by name, sorted.

    A file is named by its path below the folder without a suffix, ``deep/room``, or ``room_ply``
    beside ``room_spz``. Of each experiment the newest trained run counts, under the experiment's
    name. Results of earlier commands are skipped: files with default names, and whole folders.

    Raises:
        SceneError: if the folder is missing, is a run, or contains no scene.
    """
    folder = Path(folder)
    if not is_folder_of_scenes(folder):
        raise SceneError(f"{folder}: expected a folder with scenes below it")
    files = _files_with_gaussians(folder, is_scene_file)
    stems = {_stem(path) for path in files}
    for path in tuple(files):
        source = re.sub("_(pruned|compact|web|phone|headset|email)$", "", _stem(path))
        if source != _stem(path) and source in stems:
            logger.warning("skipped %s: a result of %s", path, source)
            files.remove(path)
    named = [(_stem(path.relative_to(folder)), path) for path in files]
    with suppress(SceneError):  # no run; skipped ones are logged already
        named += [(scene_name(run), run.folder) for run in find_runs(folder)]
    if not named:
        raise SceneError(
            f"{folder}: no scene below it; expected files ({READABLE}) or trained Splatfacto runs"
        )
    counts = Counter(name for name, _ in named)
    for index, (name, path) in enumerate(named):
        if counts[name] > 1 and path.is_file():
            named[index] = (
                name + path.as_posix()[len(_stem(path)) :].replace(".", "_").lower(),
                path,
            )
    named.sort(key=lambda pair: (pair[0], str(pair[1])))
    return dict(zip(distinct(name for name, _ in named), (path for _, path in named), strict=True))


def find_runs_and_plys(
    folder: Path, supervision: Supervision
) -> tuple[dict[str, Run], dict[str, Path], SceneError | None]:
    """The runs and PLY files at or below ``folder`` for a training, by scene name, and the error if
    no run was found. The data of runs is not searched for.

    Args:
        folder: a run, a PLY file, or any folder above several.
        supervision: ``photos`` takes runs, ``dense`` takes both, ``auto`` takes runs, or PLY files
            if there is no run.
    """
    runs: list[Run] = []
    why_no_run: SceneError | None = None
    try:
        if folder.suffix.lower() != ".ply":
            runs = find_runs(folder)
    except SceneError as error:
        why_no_run = error
    named = dict(zip(distinct(map(scene_name, runs)), runs, strict=True))
    plys: list[Path] = []
    if supervision == "dense" or (supervision == "auto" and not runs):
        plys = _files_with_gaussians(folder, lambda name: name.lower().endswith(".ply"))
    root = folder.parent if folder.is_file() else folder
    names = distinct(
        file_stem("-".join(path.relative_to(root).with_suffix("").parts)) for path in plys
    )
    return (
        named,
        {f"{n}.ply" if n in named else n: path for n, path in zip(names, plys, strict=True)},
        why_no_run,
    )


def find_runs(folder: Path | str) -> list[Run]:
    """The newest run of each experiment at or below ``folder``, sorted by experiment name.

    Runs of other methods and runs without a complete checkpoint are skipped. The data of runs is
    not searched for.

    Raises:
        SceneError: if there is no run, or ``folder`` is a run of another method.
    """
    folder = Path(folder)
    if not folder.exists():
        raise SceneError(f"{folder}: no such folder; expected a folder of trained nerfstudio runs")
    if not folder.is_dir() or (folder / RUN_FILES.config).is_file():
        run = open_run(folder, need_data=False)
        if not run.is_gaussian_scene:
            raise SceneError(
                f"{run.folder}: a run of the method {run.method_name or 'unknown'}; expected a "
                "trained Splatfacto run"
            )
        return [run]
    newest: dict[Path, Run] = {}
    passed: list[str] = []
    for place, inner, files in os.walk(folder):
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        if RUN_FILES.config not in files:
            continue
        inner.clear()  # no search inside of a run
        try:
            run = open_run(place, need_data=False)
        except SceneError as error:
            passed.append(str(error))
            if not _trains_refiner(Path(place)):  # a training that goes on, or was interrupted
                logger.warning("skipped: %s", error)
            continue
        if not run.is_gaussian_scene:
            passed.append(f"{run.folder}: method {run.method_name or 'unknown'}")
            continue
        key = _experiment_folder(run)
        if key not in newest or _when(run) > _when(newest[key]):
            newest[key] = run
    if not newest:
        seen = f"; skipped {len(passed)}, such as {passed[0]}" if passed else ""
        raise SceneError(
            f"{folder}: no trained Splatfacto run below it; expected "
            f"EXPERIMENT/METHOD/TIME/{RUN_FILES.config}{seen}"
        )
    return sorted(newest.values(), key=lambda run: (scene_name(run), str(run.folder)))


def _trains_refiner(folder: Path) -> bool:
    """Whether a folder is that of a run that trains a refiner, with or without a checkpoint."""
    try:
        method = str(read_config(folder / RUN_FILES.config).fields.get("method_name") or "")
    except SceneError:
        return False
    return is_refiner_method(method)


def distinct(names: Iterable[str]) -> list[str]:
    """The names, with ``-2``, ``-3``... appended to repeated ones."""
    unique: list[str] = []
    for base in names:
        name = base
        count = 1
        while name in unique:
            count += 1
            name = f"{base}-{count}"
        unique.append(name)
    return unique


def shown_scene(names: list[str], eval_scenes: Iterable[str]) -> str:
    """The scene for the viewer and the exporters: the first evaluation scene, or else the first."""
    held_out = set(eval_scenes)
    return next((name for name in names if name in held_out), names[0])


def _files_with_gaussians(root: Path, wanted: Callable[[str], bool]) -> list[Path]:
    """Scene files at or below a path whose names are ``wanted``, sorted.

    Folders of runs and of 3D Tiles, hidden folders and results of commands are not searched. The
    headers of PLY and glTF files are read, because they may hold points or a mesh. Pipes, sockets
    and devices are not opened, because they may never end.
    """
    paths = [root] if root.is_file() and wanted(root.name) else []
    for place, inner, files in os.walk(root):
        results = {FOLDER_FILES.scenes, FOLDER_FILES.levels, TILESET}.intersection(files)
        if RUN_FILES.config in files or (results and Path(place) != root):
            inner.clear()
            continue
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        paths += [Path(place) / name for name in files if wanted(name) and not name.startswith(".")]
    scenes = []
    for path in sorted(paths):
        if why := _why_none(path):
            logger.warning("skipped %s: %s", path, why)
        else:
            scenes.append(path)
    return scenes


def _stem(path: Path) -> str:
    """Path of a scene file without its format suffix, such as ``.compressed.ply``."""
    kind = format_named(path.name)
    return path.as_posix()[: -len(path.suffix if kind is None else kind.suffix)]


def _experiment_folder(run: Run) -> Path:
    """Folder of all runs of an experiment: EXPERIMENT of EXPERIMENT/METHOD/TIMESTAMP, or the run's
    own folder if it was moved out of that layout."""
    place = run.folder.resolve()
    as_laid_out = (place.parent.name, place.name) == (run.method_name, run.timestamp)
    return place.parents[1] if as_laid_out else place


def _when(run: Run) -> tuple[float, int]:
    """Sort key of a run's age: nerfstudio's timestamp, or the checkpoint's file time if the folder
    was renamed."""
    try:
        return datetime.strptime(run.timestamp, "%Y-%m-%d_%H%M%S").timestamp(), run.step
    except ValueError:
        return run.checkpoint.stat().st_mtime, run.step


def _why_none(path: Path) -> str:
    """Why a file holds no Gaussians: it is a PLY or glTF of points or of a mesh. Empty if it holds
    some, or if its reader reports the reason."""
    if not path.is_file():
        return "not a regular file"
    try:
        kind = format_to_read(path)
        if kind is not None and kind.read is read_gltf:
            return "" if has_gaussians(path) else "no Gaussians in it"
        if kind is None or kind.read is not read_ply:
            return ""
    except SceneError:
        return ""
    with suppress(SceneError, OSError), open_regular(path) as stream:
        for element in read_header(stream, path).elements:
            if {"opacity", "scale_0", "rot_0"} <= {name for name, _ in element.properties}:
                return ""
    return "no Gaussians in it"
