"""The folder that levels of detail are written to: a PLY and the parents of each level, a manifest, and a picture."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import content_hash, write_ply
from pointsplat_ns.io.files import replacing, write_json
from pointsplat_ns.looking.content import content_box
from pointsplat_ns.rasterizer import render

if TYPE_CHECKING:
    from pointsplat_ns.compression.levels import Level, Levels

FORMAT, VERSION = "pointsplat-lod", 1
"""Name and version of the manifest's format. The version rises when a reader of the old one would go wrong."""

MANIFEST, PICTURE = "lod.json", "lod.png"

MAX_BYTES = 1 << 24
"""A manifest has about 1 kB a level."""

_COLUMNS = 3
"""Images side by side in the picture."""


def file_names(index: int) -> tuple[str, str]:
    """Names of the files of the level at ``index``: its scene, and the parents of the next finer level."""
    return f"level_{index}.ply", f"level_{index}_parents.npy"


def check_folder(folder: Path, count: int, force: bool) -> None:
    """Check, before the long computations, that ``count`` levels may be written to a folder.

    Args:
        folder: need not exist.
        count: number of levels.
        force: whether existing files may be overwritten.

    Raises:
        SceneError: if it is a file or named like one, or holds a file that must not be overwritten. Levels that were
            interrupted may be.
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
    """Whether the levels in a folder are those of a command that was interrupted."""
    path = folder / MANIFEST
    try:
        if path.stat().st_size > MAX_BYTES:
            return False
        manifest = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(manifest, dict) and manifest.get("format") == FORMAT and manifest.get("complete") is False


class LevelFolder:
    """Writes levels to a folder, one after the other. Every file is written beside and renamed, so that an interruption
    leaves whole files and a manifest that is true of them.

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
            # Older levels are overwritten from here on.
            write_json({"format": FORMAT, "version": VERSION, "complete": False, "levels": []}, self.folder / MANIFEST)
            (self.folder / PICTURE).unlink(missing_ok=True)
        scene_name, parents_name = file_names(len(self._written))
        write_ply(scene, self.folder / scene_name)
        with replacing(self.folder / parents_name) as part, part.open("wb") as stream:
            np.save(stream, parents.cpu().numpy())
        self._written.append({**self._facts(scene_name), "parents": self._facts(parents_name)})

    def write_manifest(self, levels: Levels, complete: bool = True) -> None:
        """Write the manifest of the levels that were written and measured so far.

        Raises:
            SceneError: if it cannot be written.
        """
        content = {
            "format": FORMAT,
            "version": VERSION,
            "complete": complete,
            "source": _source(levels),
            "bounds": _bounds(levels.dense),
            "views": _views(levels),
            "levels": [
                {**files, **_level(level, len(levels.dense))}
                for files, level in zip(self._written, levels, strict=True)
            ],
        }
        write_json(content, self.folder / MANIFEST)

    def write_picture(self, levels: Levels) -> None:
        """Draw one view of the dense scene and of every level, if there is a view.

        Raises:
            SceneError: if it cannot be written.
        """
        if levels.reference is not None:
            _draw(levels, self.folder / PICTURE)

    def _facts(self, name: str) -> dict[str, Any]:
        path = self.folder / name
        return {"file": name, "bytes": path.stat().st_size, "sha256": content_hash(path)}


def _source(levels: Levels) -> dict[str, Any]:
    file = levels.source
    return {
        "file": file and file.name,
        "bytes": file and file.bytes,
        "sha256": file and file.sha256,
        "count": len(levels.dense),
        "sh_degree": levels.dense.sh_degree,
        "psnr_farther": _farther(levels.farther) if levels.reference is not None else None,
    }


def _bounds(dense: Gaussians) -> dict[str, Any]:
    """Boxes about the centres of all Gaussians, and about 90 % of the opacity along each axis."""
    boxes = {"all": (dense.means.amin(dim=0), dense.means.amax(dim=0))}
    if bool((dense.alphas > 0).any()):
        boxes["content"] = content_box(dense)
    return {name: {"min": low.tolist(), "max": high.tolist()} for name, (low, high) in boxes.items()}


def _views(levels: Levels) -> dict[str, Any] | None:
    if levels.reference is None:
        return None
    views = levels.reference.views
    focal = float(views.Ks[:, 1, 1].median())
    return {
        "count": len(views),
        "origin": levels.origin,
        "width": views.width,
        "height": views.height,
        "focal": focal,
        "distance": levels.distance,
        "pixel_size": levels.distance and levels.distance / focal,
    }


def _level(level: Level, whole: int) -> dict[str, Any]:
    errors = level.errors
    return {
        "count": len(level.scene),
        "share": len(level.scene) / whole,
        "sh_degree": level.scene.sh_degree,
        "dropped": level.dropped,
        "median_size": level.median_size,
        "displacement": {
            "rms": level.displacement.rms,
            "median": level.displacement.median,
            "p95": level.displacement.p95,
        },
        "mse": errors and errors.near.error,
        "psnr": errors and errors.near.psnr,
        "worst_psnr": errors and errors.near.worst,
        "ssim": errors and errors.near.ssim,
        "psnr_farther": errors and _farther(errors.farther),
    }


def _farther(psnrs: dict[int, float]) -> list[dict[str, Any]]:
    return [{"times": times, "psnr": psnr} for times, psnr in psnrs.items()]


@torch.no_grad()
def _draw(levels: Levels, path: Path) -> None:
    """The view whose error at the coarsest level is the median: the dense scene, then every level."""
    from matplotlib.figure import Figure

    assert levels.reference is not None
    views, renders = levels.reference.views, levels.reference.renders
    last = levels[-1].errors
    assert last is not None
    shown = int(np.argsort(last.near.errors, kind="stable")[(len(views) - 1) // 2])
    images = [renders[shown]]
    captions = [f"dense: {len(levels.dense):,} Gaussians"]
    for index, level in enumerate(levels):
        assert level.errors is not None
        images.append(render(level.scene, views[shown]))
        share = 100 * len(level.scene) / len(levels.dense)
        captions.append(f"level {index}: {len(level.scene):,} ({share:.3g} %), {level.errors.view_psnr(shown):.1f} dB")
    columns = min(_COLUMNS, len(images))
    rows = math.ceil(len(images) / columns)
    width = 5.0  # of an image, inches
    figure = Figure(figsize=(width * columns, rows * (width * views.height / views.width + 0.4)), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes[len(images) :]:
        axis.set_axis_off()
    for axis, image, caption in zip(axes, images, captions, strict=False):
        axis.imshow(image.cpu().clamp(0, 1).numpy())
        axis.set_xticks([])
        axis.set_yticks([])
        axis.set_xlabel(caption, fontsize=12)
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png")
