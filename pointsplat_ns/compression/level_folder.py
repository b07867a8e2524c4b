"""The folder of written levels of detail: a PLY and the parents of each level, a manifest, and a picture."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import content_hash, write_ply
from pointsplat_ns.io.files import replacing, write_json

FORMAT = {"format": "pointsplat-lod", "version": 1}
"""Format of the manifest. The version rises with each change that readers of the old version misread."""

MANIFEST, PICTURE = "lod.json", "lod.png"


def file_names(index: int) -> tuple[str, str]:
    """Names of the files of the level at ``index``: its scene, and the parents of the next finer level."""
    return f"level_{index}.ply", f"level_{index}_parents.npy"


def check_folder(folder: Path, count: int, force: bool) -> None:
    """Check that ``count`` levels may be written to a folder, before the long computations.

    Args:
        folder: need not exist.
        count: number of levels.
        force: whether existing files may be overwritten.

    Raises:
        SceneError: if it is a file or named like one, or holds a file that must not be overwritten. Levels of an
            interrupted command may be overwritten.
    """
    if folder.suffix.lower() in (".ply", ".json", ".png"):
        raise SceneError(f"{folder}: levels are several files; expected the name of a folder")
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; expected the name of a folder")
    force = force or is_unfinished(folder)
    for name in (MANIFEST, PICTURE, *(name for index in range(count) for name in file_names(index))):
        if (folder / name).exists() and not force:
            raise SceneError(f"{folder / name}: exists already; name another folder, or overwrite it with --force")


def is_unfinished(folder: Path) -> bool:
    """Whether a folder holds the levels of an interrupted command."""
    path = folder / MANIFEST
    try:
        if path.stat().st_size > 1 << 24:  # a manifest has about 1 kB for each level
            return False
        manifest = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return (
        isinstance(manifest, dict) and manifest.get("format") == FORMAT["format"] and manifest.get("complete") is False
    )


class LevelFolder:
    """Writes levels to a folder, one after the other. Every file is written beside and renamed, so that an interruption
    leaves whole files and a manifest that fits them.

    Args:
        folder: created with the first file.
        count: number of levels.
        force: whether existing files may be overwritten.

    Raises:
        SceneError: if the folder cannot be used, see :func:`check_folder`.
    """

    def __init__(self, folder: Path | str, count: int, force: bool = False):
        self.folder = Path(folder)
        check_folder(self.folder, count, force)
        self._written: list[dict[str, Any]] = []

    def write_level(self, scene: Gaussians, parents: Tensor) -> None:
        """Write the next coarser level: its scene and the parents (M,) int32 of the level before it.

        Raises:
            SceneError: if a file cannot be written.
        """
        if not self._written:
            # From here on older levels are overwritten.
            write_json({**FORMAT, "complete": False, "levels": []}, self.folder / MANIFEST)
            (self.folder / PICTURE).unlink(missing_ok=True)
        scene_name, parents_name = file_names(len(self._written))
        write_ply(scene, self.folder / scene_name)
        with replacing(self.folder / parents_name) as part, part.open("wb") as stream:
            np.save(stream, parents.cpu().numpy())
        self._written.append({**self._facts(scene_name), "parents": self._facts(parents_name)})

    def write_manifest(self, about: dict[str, Any], levels: Sequence[dict[str, Any]], complete: bool = True) -> None:
        """Write the manifest of the levels written so far.

        Args:
            about: facts on all levels together.
            levels: facts on each written level.
            complete: whether these are all levels.

        Raises:
            SceneError: if it cannot be written.
        """
        rows = [{**files, **facts} for files, facts in zip(self._written, levels, strict=True)]
        write_json({**FORMAT, "complete": complete, **about, "levels": rows}, self.folder / MANIFEST)

    def write_picture(self, images: Sequence[Tensor], captions: Sequence[str]) -> None:
        """Draw images (H, W, 3) of one size with a caption below each; without images, draw none.

        Raises:
            SceneError: if it cannot be written.
        """
        from matplotlib.figure import Figure

        if not images:
            return
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
        with replacing(self.folder / PICTURE) as part:
            figure.savefig(part, dpi=100, format="png")

    def _facts(self, name: str) -> dict[str, Any]:
        path = self.folder / name
        return {"file": name, "bytes": path.stat().st_size, "sha256": content_hash(path)}
