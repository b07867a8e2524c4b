"""The folder of written levels of detail: a PLY of each level, and a manifest."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.discovery import FOLDER_FILES
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.system.files import content_hash, replacing, write_json


def check_folder(folder: Path, names: Iterable[str], force: bool) -> None:
    """Raise a SceneError, before the long computations, if files may not be written to a folder: it
    is a file or named like one, or holds one of these files, which must not be overwritten."""
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
    """Write all levels and their manifest, or nothing.

    All files are written beside before the first replaces an older one. Meanwhile there is no
    manifest, so that a folder with it is whole.

    Args:
        folder: created if it is missing.
        levels: their scenes.
        about, facts: the manifest's facts on all levels together, and on each.
        force: whether existing files may be overwritten.

    Raises:
        SceneError: if the folder cannot be used, see :func:`check_folder`, or a file cannot be
            written.
    """
    folder = Path(folder)
    check_folder(folder, level_names(len(levels)), force)
    rows = []
    with ExitStack() as stack:
        stack.callback(_remove_if_empty, folder)  # after an error

        def part_of(name: str) -> Path:
            return stack.enter_context(replacing(folder / name))

        manifest = part_of(FOLDER_FILES.levels)  # entered first, left last
        for scene, fact, name in zip(levels, facts, level_names(len(levels))[1:], strict=True):
            part = part_of(name)
            write_ply(scene, part)
            rows.append(
                {"file": name, "bytes": part.stat().st_size, "sha256": content_hash(part), **fact}
            )
        write_json({"format": "pointsplat-lod", "version": 2, **about, "levels": rows}, manifest)
        (folder / FOLDER_FILES.levels).unlink(missing_ok=True)


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):
        folder.rmdir()


def level_names(count: int) -> list[str]:
    """Names of the files of a number of levels: the manifest, then a PLY of each."""
    return [FOLDER_FILES.levels, *(f"level_{index}.ply" for index in range(count))]
