"""Levels of detail as 3D Tiles: a tree of cells, which a viewer refines where it needs more."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import replacing
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.glb_tile import TILE_EXTENSIONS, encode_tile
from pointsplat_ns.io.formats.holding import typical_sizes
from pointsplat_ns.io.offsets import from_centre
from pointsplat_ns.io.scene import warn_of_losses
from pointsplat_ns.levels.folder import check_folder
from pointsplat_ns.levels.tree import Cell, cells
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES

TILESET = "tileset.json"
"""The file that tells of all others."""

PIXELS = 16.0
"""Pixels of error at which CesiumJS refines a tile, unless it is told another number."""


def placed(levels: Sequence[Gaussians]) -> tuple[list[Gaussians], Tensor]:
    """Levels, the finest first, as float32 on the CPU, about the middle of the coarsest, and the matrix (4, 4) float64
    from there to the frame of the scene's file."""
    scenes = [scene.detach().to("cpu", torch.float32) for scene in levels]
    middle = from_centre(scenes[-1]).offset or (0.0, 0.0, 0.0)
    matrix = torch.eye(4, **DOUBLES)
    matrix[:3, 3] = torch.tensor(middle, **DOUBLES)
    return [scene.at_offset(middle).replace(offset=None) for scene in scenes], matrix


def write_tiles(
    folder: Path | str,
    levels: Sequence[Gaussians],
    parents: Sequence[Tensor],
    pixel_sizes: Sequence[float],
    matrix: Tensor,
    force: bool = False,
    progress: Progress = silent,
    most: int = 1 << 16,
) -> list[int]:
    """Write levels of detail as 3D Tiles of glTF with SPZ, which CesiumJS draws: all of them, or nothing.

    All files are written beside before the first replaces an older one. Meanwhile there is no ``tileset.json``.

    Args:
        folder: created if it is missing.
        levels: the finest first, float32 on the CPU; z is up.
        parents: for each level but the last, the index (M,) in the next of the parent of each Gaussian; -1 for those
            that are too faint to be drawn, which are left out.
        pixel_sizes: of each level, scene units a pixel from which on it shows enough.
        matrix: (4, 4) float64, from the levels' frame to that of the tiles.
        force: whether existing tiles may be overwritten.
        progress: called while encoding.
        most: Gaussians in a tile, but for children of one parent.

    Returns:
        The number of Gaussians written of each level.

    Raises:
        SceneError: if the folder cannot be used, or a file cannot be written.
    """
    folder = Path(folder)
    check_folder(folder, (TILESET,), force)
    warn_of_losses(format_to_write(".spz"), levels[0], folder)
    tops = cells(levels, parents, most)
    count = sum(1 for top in tops for _ in _all(top))
    errors = [PIXELS * size for size in itertools.accumulate(pixel_sizes, max)]
    counts, number = [0] * len(levels), itertools.count()

    def tile(cell: Cell) -> dict[str, Any]:
        scene, index = levels[cell.level][cell.rows], next(number)
        progress(f"tile {index + 1} of {count}", index / count)
        low, high = _box(scene)
        x, y, z = (0.5 * (low + high)).tolist()
        name = f"tiles/{cell.level}_{index}.glb"
        data = encode_tile(scene.at_offset((x, y, z)))
        stack.enter_context(replacing(folder / name, len(data))).write_bytes(data)
        counts[cell.level] += len(scene)
        children = [tile(child) for child in cell.children]
        error = errors[cell.level] if children else 0.0
        return {**_node(torch.stack([low, high]), children, error), "content": {"uri": name}}

    with ExitStack() as stack:
        part = stack.enter_context(replacing(folder / TILESET))  # entered first, left last
        root = _node(None, [tile(top) for top in tops], max(errors))
        root["geometricError"] = max(root["geometricError"], 2 * sum(root["boundingVolume"]["box"][3::4]))
        extensions = {name: list(TILE_EXTENSIONS) for name in ("extensionsUsed", "extensionsRequired")}
        tileset = {
            "asset": {"version": "1.1", "generator": "pointsplat-ns"},
            "extensionsUsed": ["3DTILES_content_gltf"],
            "extensions": {"3DTILES_content_gltf": extensions},
            "geometricError": root["geometricError"],
            "root": {"transform": matrix.T.flatten().tolist(), "refine": "REPLACE", **root},
        }
        part.write_text(json.dumps(tileset, separators=(",", ":")), "utf-8")
        (folder / TILESET).unlink(missing_ok=True)
    return counts


def _all(cell: Cell) -> Iterator[Cell]:
    yield cell
    for child in cell.children:
        yield from _all(child)


def _box(scene: Gaussians) -> tuple[Tensor, Tensor]:
    """The corners of the box of all centres and of three times the middle size about them. That of the largest
    Gaussians would be so large that viewers would refine what is far away."""
    margin = 3 * typical_sizes(scene).median()
    return scene.means.double().amin(dim=0) - margin, scene.means.double().amax(dim=0) + margin


def _node(corners: Tensor | None, children: list[dict[str, Any]], error: float) -> dict[str, Any]:
    """A tile without content, with the box of its own corners (2, 3) and those of its children."""
    boxes = torch.tensor([child["boundingVolume"]["box"] for child in children], **DOUBLES).reshape(-1, 12)
    middle, half = boxes[:, :3], boxes[:, 3::4]
    points = torch.cat([middle - half, middle + half, *([] if corners is None else [corners])])
    low, high = points.aminmax(dim=0)
    axes = torch.diag(0.5 * (high - low)).flatten().tolist()
    node = {"boundingVolume": {"box": [*(0.5 * (low + high)).tolist(), *axes]}, "geometricError": error}
    return {**node, "children": children} if children else node
