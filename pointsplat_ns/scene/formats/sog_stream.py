"""Streamed SOG: PlayCanvas' folder of SOG files, for viewers that load a scene in parts.

``lod-meta.json`` holds a tree of boxes. For each level of detail, finest first, a leaf names
consecutive rows of one SOG folder, ``LEVEL_NUMBER/meta.json``. A viewer draws one level of every
leaf. Reading gives the scene of one level.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.scene.formats.coding import damage_named, file_beside, joined
from pointsplat_ns.scene.formats.sog import read_sog, sog_parts
from pointsplat_ns.scene.formats.sog_images import SOG_META
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.usable import usable_part
from pointsplat_ns.system.files import (
    read_text,
    replacing,
    replacing_folder,
    require_file,
    require_memory,
)
from pointsplat_ns.system.progress import Progress, silent

STREAM_META = "lod-meta.json"
"""Index file."""

OWN_FILES = rf"{re.escape(STREAM_META)}|\d+_\d+"
"""Pattern of the file names written into a stream's folder."""


@dataclass(frozen=True, eq=False)
class Node:
    """A node of the tree: a leaf, or an inner node with two children."""

    rows: tuple[Tensor, ...] = ()
    """For a leaf: indices of its Gaussians in each level."""
    children: tuple[Node, ...] = ()


def read_sog_stream(path: Path | str, level: int = 0) -> Gaussians:
    """Read one level of a streamed SOG, and its surroundings (``environment``) if it has them.

    Args:
        path: ``lod-meta.json`` or its folder.
        level: 0 is the finest.

    Raises:
        SceneError: if there is no such level, or a file is missing, is damaged, lies outside of the
            folder, or has another number of Gaussians than the tree declares.
    """
    path = Path(path)
    path = path / STREAM_META if path.is_dir() else path
    require_file(path, f"the {STREAM_META} of a streamed SOG")
    with damage_named(path, "streamed SOG"):
        meta = _meta(path)
        levels = meta["lodLevels"]
        if not 0 <= level < levels:
            raise SceneError(f"{path}: no level {level}; it has {levels}, 0 is the finest")
        counts = _counts(meta["tree"], level, meta["filenames"])
        require_memory(path, 4 * 14 * sum(counts.values()))
        files = {_beside(path, meta["filenames"][index]): counts[index] for index in sorted(counts)}
        around = [] if meta.get("environment") is None else [_beside(path, meta["environment"])]
    parts = []
    for file, count in files.items():
        parts.append(read_sog(file))
        if count != len(parts[-1]):
            raise SceneError(
                f"{file}: {len(parts[-1])} Gaussians; {STREAM_META} names {count} of level {level}"
            )
    return joined([*parts, *map(read_sog, around)])


def coarser_levels(path: Path, finest: int) -> list[Gaussians]:
    """All levels of a streamed SOG below the finest, which has ``finest`` Gaussians, in order.

    Stops once they have more than twice that number in total. Empty for any other path. Raises
    SceneError as :func:`read_sog_stream`.
    """
    path = path / STREAM_META if path.is_dir() else path
    if path.name != STREAM_META or not path.is_file():
        return []
    with damage_named(path, "streamed SOG"):
        count = _meta(path)["lodLevels"]
    levels: list[Gaussians] = []
    for level in range(1, count):
        levels.append(usable_part(read_sog_stream(path, level)))
        if sum(map(len, levels)) > 2 * finest:
            break
    return levels


def stream_parts(path: Path) -> list[Path]:
    """All files of the streamed SOG with this ``lod-meta.json``, which comes first. Raises
    SceneError as :func:`read_sog_stream`."""
    with damage_named(path, "streamed SOG"):
        meta = _meta(path)
        names = [name for name in (*meta["filenames"], meta.get("environment")) if name is not None]
        found = [path]
        for file in (_beside(path, name) for name in names):
            found += (
                [file] if file.name != SOG_META else sorted(file.parent.glob("*.webp")) + [file]
            )
        return found


def write_sog_stream(
    levels: Sequence[Gaussians],
    tree: Node,
    path: Path,
    chunk: int,
    progress: Progress = silent,
    force: bool = True,
) -> dict[str, Any]:
    """Write a streamed SOG atomically.

    All files are written to temporary names before the first one replaces an older file, see
    :func:`~pointsplat_ns.system.files.replacing_folder`.

    Args:
        levels: finest first; float32 on the CPU, drawable Gaussians only.
        tree: its leaves have rows of every level. Gaussians in no leaf are dropped.
        path: the ``lod-meta.json``. Its folder is created if missing.
        chunk: a SOG file is complete once it has more Gaussians than this.
        progress: called during encoding.
        force: whether to replace existing files.

    Returns:
        The content of ``lod-meta.json``.

    Raises:
        SceneError: if a file cannot be written.
    """
    files: list[tuple[int, list[Tensor]]] = []  # level and rows of each file
    last: dict[int, int] = {}  # last file of each level
    names: list[str] = []

    def entry(level: int, members: Tensor) -> dict[str, int]:
        file = last.get(level, -1)
        held = sum(map(len, files[file][1])) if file >= 0 else 0
        if file < 0 or held > chunk:
            file = len(files)
            held = 0
            names.append(f"{level}_{sum(level == other for other, _ in files)}/{SOG_META}")
            files.append((level, []))
            last[level] = file
        files[file][1].append(members)
        return {"file": file, "offset": held, "count": len(members)}

    def node(part: Node) -> dict[str, Any]:
        if part.children:
            children = [node(child) for child in part.children]
            lows, highs = zip(
                *((child["bound"]["min"], child["bound"]["max"]) for child in children), strict=True
            )
            bound = {"min": [min(axis) for axis in zip(*lows, strict=True)]}
            return {
                "bound": bound | {"max": [max(axis) for axis in zip(*highs, strict=True)]},
                "children": children,
            }
        lods = {
            str(level): entry(level, members)
            for level, members in enumerate(part.rows)
            if len(members)
        }
        bound = _bound([scene[members] for scene, members in zip(levels, part.rows, strict=True)])
        return {"bound": bound, "lods": lods}

    described = node(tree)
    counts = [
        sum(len(part) for at, parts in files if at == level for part in parts)
        for level in range(len(levels))
    ]
    meta = {
        "version": 1,
        "asset": {"generator": "pointsplat-ns"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "lodErrors": False,
        "filenames": names,
        "tree": described,
    }
    with replacing_folder(path.parent, path.name, OWN_FILES, force) as beside:
        (beside / path.name).write_text(json.dumps(meta, separators=(",", ":")), "utf-8")
        for file, (name, (level, rows)) in enumerate(zip(names, files, strict=True)):

            def report(what: str, share: float, done: int = file) -> None:
                progress(f"file {done + 1} of {len(names)}", (done + share) / len(names))

            parts = sog_parts(levels[level][torch.cat(rows)], report, ordered=True)
            for part, data in parts.items():
                part_path = (beside / name).with_name(part)
                with replacing(part_path, len(data)) as place:
                    place.write_bytes(data)
    return meta


def _bound(parts: Sequence[Gaussians]) -> dict[str, list[float]]:
    """Bounding box of all Gaussians, as boxes of one standard deviation along their axes, which is
    how other programs compute it; printed with the digits of float32."""
    scene = joined(parts, 0)
    half = (rotation_matrices(scene.quats).abs() @ scene.stds[..., None])[..., 0]
    limit = torch.finfo(torch.float32).max
    corners = {"min": (scene.means - half).amin(dim=0), "max": (scene.means + half).amax(dim=0)}
    return {
        name: [float(f"{value:.7g}") for value in corner.nan_to_num(0.0, limit, -limit).tolist()]
        for name, corner in corners.items()
    }


def _meta(path: Path) -> dict[str, Any]:
    """The content of ``lod-meta.json``, checked except for its tree."""
    meta = json.loads(read_text(path))
    if not isinstance(meta, dict) or meta.get("version", 1) != 1:
        raise SceneError(f"{path}: not a {STREAM_META} of version 1")
    levels = meta["lodLevels"]
    names = meta["filenames"]
    if not isinstance(levels, int) or isinstance(levels, bool) or not 0 < levels <= 1000:
        raise ValueError(f"{levels!r} levels, expected 1 to 1000")
    if (
        not isinstance(names, list)
        or not all(isinstance(name, str) for name in names)
        or len({*names}) != len(names)
    ):
        raise ValueError("filenames are not a list of distinct names")
    return meta


def _beside(path: Path, name: Any) -> Path:
    """A SOG file named in ``lod-meta.json``, which must be in or below its folder."""
    file = file_beside(path, name)
    if file.name != SOG_META and not name.lower().endswith(".sog"):
        raise SceneError(f"{path}: names the file {name!r}; expected a {SOG_META} or a .sog")
    return file


def _counts(tree: Any, level: int, names: list[str]) -> Counter[int]:
    """Number of Gaussians of a level in each file according to the tree, by file index."""
    counts: Counter[int] = Counter()
    waiting = [tree]
    while waiting:
        node = waiting.pop()
        if not isinstance(node, dict) or not isinstance(node.get("children", []), list):
            raise ValueError("a node of the tree is not an object")
        waiting += node.get("children", [])
        lods = node.get("lods", {})
        if not isinstance(lods, dict):
            raise ValueError(f"lods of a node are a {type(lods).__name__}, expected an object")
        entry = lods.get(str(level))
        if entry is None:
            continue
        numbers = [entry[key] for key in ("file", "offset", "count")]
        if not all(isinstance(number, int) and 0 <= number < math.inf for number in numbers):
            raise ValueError(f"rows {numbers} of a level, expected whole numbers")
        if numbers[0] >= len(names):
            raise ValueError(f"file {numbers[0]} of {len(names)}")
        counts[numbers[0]] += numbers[2]
    return counts
