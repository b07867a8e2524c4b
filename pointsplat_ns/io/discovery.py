"""Folders as sets of scenes: PLY files, trained runs, or both."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Literal

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.files import logger
from pointsplat_ns.io.ply_header import read_header
from pointsplat_ns.io.runs import CONFIG_NAME, Run, distinct, find_runs, scene_names

Supervision = Literal["auto", "photos", "dense"]


def find_plys(folder: Path) -> list[tuple[str, Path]]:
    """Name and path of every 3DGS PLY at or below ``folder``, sorted by path.

    What lies in the folder of a nerfstudio run, and PLY files that hold no Gaussians, are passed over.
    """
    if folder.is_file():
        paths = [folder] if folder.suffix.lower() == ".ply" else []
        root = folder.parent
    else:
        paths, root = [], folder
        for place, inner, files in os.walk(folder):
            if CONFIG_NAME in files:
                inner.clear()
                continue
            inner[:] = sorted(name for name in inner if not name.startswith("."))
            paths += [Path(place) / name for name in files if name.lower().endswith(".ply")]
    found, names = [], []
    for path in sorted(paths):
        if not _holds_gaussians(path):
            logger.warning("passed over %s: no Gaussians in it", path)
            continue
        parts = path.relative_to(root).with_suffix("").parts
        names.append(re.sub(r"[^\w.+-]+", "-", "-".join(parts)).strip("-.") or "scene")
        found.append(path)
    return list(zip(distinct(names), found, strict=True))


def find_runs_and_plys(
    folder: Path, supervision: Supervision
) -> tuple[dict[str, Run], dict[str, Path], SceneError | None]:
    """The runs and the PLY files at or below ``folder`` that a training takes, by the names that it gives them.

    Args:
        folder: a run, a PLY file, or any folder above several.
        supervision: ``photos`` takes runs, ``dense`` both, ``auto`` runs, or PLY files where there is no run.

    Returns:
        Runs, whose data is not looked for; PLY files; and why there is no run, if looking for one failed.
    """
    runs: list[Run] = []
    nothing: SceneError | None = None
    try:
        if folder.suffix.lower() != ".ply":
            runs = find_runs(folder, need_data=False)
    except SceneError as error:
        nothing = error
    named = dict(zip(scene_names(runs), runs, strict=True))
    found = find_plys(folder) if supervision == "dense" or (supervision == "auto" and not runs) else []
    return named, {f"{name}.ply" if name in named else name: path for name, path in found}, nothing


def _holds_gaussians(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            elements = read_header(stream, path).elements
    except (SceneError, OSError):
        return False
    return any({"opacity", "scale_0", "rot_0"} <= {name for name, _ in element.properties} for element in elements)
