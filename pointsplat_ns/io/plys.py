"""A folder of PLY files as a set of scenes."""

from __future__ import annotations

import os
import re
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.io.files import logger
from pointsplat_ns.io.ply_header import read_header
from pointsplat_ns.io.runs import CONFIG_NAME, distinct


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


def _holds_gaussians(path: Path) -> bool:
    try:
        with path.open("rb") as stream:
            elements = read_header(stream, path).elements
    except (SceneError, OSError):
        return False
    return any({"opacity", "scale_0", "rot_0"} <= {name for name, _ in element.properties} for element in elements)
