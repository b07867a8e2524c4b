"""The folder of written levels of detail: a PLY of each level, a manifest, and a picture."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import content_hash, write_ply
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.io.files import replacing, write_json


def check_folder(folder: Path, names: Iterable[str], force: bool) -> None:
    """Raise a SceneError, before the long computations, if files may not be written to a folder: it is a file or named
    like one, or holds one of these files, which must not be overwritten."""
    if folder.suffix.lower() in (".ply", ".sog", ".json", ".png", ".rad") or (folder.exists() and not folder.is_dir()):
        raise SceneError(f"{folder}: levels are several files; expected the name of a folder")
    for name in names:
        if (folder / name).exists() and not force:
            raise SceneError(f"{folder / name}: exists already; name another folder, or overwrite it with --force")


def check_level_folder(folder: Path, count: int, force: bool) -> None:
    """:func:`check_folder` for ``count`` levels."""
    check_folder(folder, (FOLDER_FILES.levels, FOLDER_FILES.levels_picture, *map(_file_name, range(count))), force)


def write_levels(
    folder: Path | str,
    levels: Sequence[Gaussians],
    about: dict[str, Any],
    facts: Sequence[dict[str, Any]],
    images: Sequence[Tensor] = (),
    captions: Sequence[str] = (),
    force: bool = False,
) -> None:
    """Write all levels, their manifest and their picture, or nothing.

    All files are written beside before the first replaces an older one. Meanwhile there is no manifest, so that a
    folder with it is whole.

    Args:
        folder: created if it is missing.
        levels: their scenes.
        about, facts: the manifest's facts on all levels together, and on each.
        images, captions: (H, W, 3) each, of one size, with text below; none for no picture.
        force: whether existing files may be overwritten.

    Raises:
        SceneError: if the folder cannot be used, see :func:`check_level_folder`, or a file cannot be written.
    """
    folder = Path(folder)
    check_level_folder(folder, len(levels), force)
    rows = []
    with ExitStack() as stack:

        def part_of(name: str) -> Path:
            return stack.enter_context(replacing(folder / name))

        manifest = part_of(FOLDER_FILES.levels)  # entered first, left last
        for index, scene in enumerate(levels):
            part = part_of(_file_name(index))
            write_ply(scene, part)
            file = {"file": _file_name(index), "bytes": part.stat().st_size, "sha256": content_hash(part)}
            rows.append({**file, **facts[index]})
        if images:
            _draw(images, captions, part_of(FOLDER_FILES.levels_picture))
        write_json({"format": "pointsplat-lod", "version": 1, **about, "levels": rows}, manifest)
        for name in (FOLDER_FILES.levels, *(() if images else (FOLDER_FILES.levels_picture,))):
            (folder / name).unlink(missing_ok=True)


def _file_name(index: int) -> str:
    return f"level_{index}.ply"


def _draw(images: Sequence[Tensor], captions: Sequence[str], path: Path) -> None:
    """Draw images with a caption below each."""
    from matplotlib.figure import Figure

    columns, panel = min(3, len(images)), 5.0  # inches across
    rows = math.ceil(len(images) / columns)
    height, width = images[0].shape[:2]
    size = (panel * columns, rows * (panel * height / width + 0.4))
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(images) :]:
        axis.set_axis_off()
    for axis, image, caption in zip(axes, images, captions, strict=False):
        axis.imshow(image.cpu().clamp(0, 1).numpy())
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_xlabel(caption, fontsize=12)
    figure.savefig(path, dpi=100, format="png")
