"""Writes levels of detail to a folder: a PLY per level, and a manifest."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.discovery import FOLDER_FILES
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.system.files import content_hash, replacing_folder, write_json

OWN_FILES = rf"{re.escape(FOLDER_FILES.levels)}|level_\d+\.ply"
"""Pattern of file names in the folder."""


def check_folder(folder: Path, names: Iterable[str], force: bool) -> None:
    """Raise a SceneError, before long computations, if ``folder`` is a file or named like one, or
    contains one of the files ``names``, unless ``force``."""
    if folder.suffix.lower() in (".ply", ".sog", ".json", ".png", ".rad") or (
        folder.exists() and not folder.is_dir()
    ):
        raise SceneError(f"{folder}: levels are several files; expected the name of a folder")
    for name in names:
        if (folder / name).exists() and not force:
            raise SceneError(
                f"{folder / name}: exists already; name another folder, or overwrite it with "
                "--force"
            )


def write_levels(
    folder: Path | str,
    levels: Sequence[Gaussians],
    about: dict[str, Any],
    facts: Sequence[dict[str, Any]],
    force: bool = False,
) -> None:
    """Write all levels and the manifest, or nothing.

    All files are complete before the first replaces an older one, see
    :func:`~pointsplat_ns.system.files.replacing_folder`.

    Args:
        folder: created if it is missing.
        levels: scenes of the levels, the finest first.
        about, facts: entries of the manifest on all levels together, and on each level.
        force: whether existing files may be overwritten.

    Raises:
        SceneError: if the folder cannot be used, see :func:`check_folder`, or a file cannot be
            written.
    """
    folder = Path(folder)
    check_folder(folder, level_names(len(levels)), force)
    rows = []
    manifest = FOLDER_FILES.levels
    with replacing_folder(folder, manifest, OWN_FILES, force) as beside:
        for scene, fact, name in zip(levels, facts, level_names(len(levels))[1:], strict=True):
            part = beside / name
            write_ply(scene, part)
            rows.append(
                {"file": name, "bytes": part.stat().st_size, "sha256": content_hash(part), **fact}
            )
        about = {"format": "pointsplat-lod", "version": 2, **about, "levels": rows}
        write_json(about, beside / manifest)


def level_names(count: int) -> list[str]:
    """File names of ``count`` levels: the manifest, then a PLY per level."""
    return [FOLDER_FILES.levels, *(f"level_{index}.ply" for index in range(count))]
