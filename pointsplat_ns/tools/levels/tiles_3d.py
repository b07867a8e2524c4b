"""Writes levels of detail as 3D Tiles: a tree of cells, which a viewer refines on demand."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.geometry.earth import Place
from pointsplat_ns.geometry.transforms import smallest_turn
from pointsplat_ns.scene.formats import format_to_write
from pointsplat_ns.scene.formats.capacity import typical_sizes
from pointsplat_ns.scene.formats.glb_tile import TILE_EXTENSIONS, encode_tile
from pointsplat_ns.scene.formats.gltf import SPZ_INSIDE
from pointsplat_ns.scene.formats.gltf_nodes import EXTRAS
from pointsplat_ns.scene.formats.tileset import TILESET
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.offsets import from_centre
from pointsplat_ns.scene.reading import warn_of_losses
from pointsplat_ns.system.files import replacing, replacing_folder
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.tools.levels.tree import Cell, cells
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.upright import known_up, up_named


def placed(
    levels: Sequence[Gaussians], dense: Gaussians, at: str | None, up: str | None
) -> tuple[list[Gaussians], Tensor]:
    """Levels centred on the middle of the coarsest, float32 on the CPU, and the matrix (4, 4)
    float64 to the frame of the tiles: the frame of the scene's file, or of the Earth.

    Args:
        levels: the finest first.
        dense: the scene of the levels.
        at: place on the Earth, see :meth:`~pointsplat_ns.geometry.earth.Place.parse`; None for the
            frame of the scene's file.
        up: up axis if ``at`` is a point; by default declared by the scene, or estimated.
    """
    scenes = [scene.detach().to("cpu", torch.float32) for scene in levels]
    middle = from_centre(scenes[-1]).offset or (0.0, 0.0, 0.0)
    matrix = torch.eye(4, **DOUBLES)
    point = torch.tensor(middle, **DOUBLES)
    place = None if at is None else Place.parse(at)
    if place is None:
        matrix[:3, 3] = point
    elif place.zone is None:
        direction = (known_up(up_named(up), dense) or Sampler(dense).up).direction.double().cpu()
        turn = smallest_turn(direction, torch.tensor([0.0, 0.0, 1.0], **DOUBLES))
        matrix = place.frame(point - torch.tensor(dense.offset or (0.0, 0.0, 0.0), **DOUBLES), turn)
    else:
        matrix = place.frame(point, torch.eye(3, **DOUBLES))
    return [scene.at_offset(middle).replace(offset=None) for scene in scenes], matrix


def write_tiles(
    folder: Path,
    levels: Sequence[Gaussians],
    parents: Sequence[Tensor],
    pixel_sizes: Sequence[float],
    matrix: Tensor,
    progress: Progress = silent,
    most: int = 1 << 16,
    force: bool = True,
    spz_version: int = SPZ_INSIDE,
) -> list[int]:
    """Write levels of detail as 3D Tiles of glTF with SPZ, for CesiumJS: all of them, or nothing.

    All files are complete before the first replaces an older one, see
    :func:`~pointsplat_ns.system.files.replacing_folder`.

    Args:
        folder: created if it is missing.
        levels: the finest first, float32 on the CPU; z is up.
        parents: for all levels but the last, index (M,) of each Gaussian's parent in the next
            level; -1 for Gaussians too faint to draw, which are dropped.
        pixel_sizes: scene units per pixel at which each level suffices.
        matrix: (4, 4) float64, from the levels' frame to that of the tiles.
        progress: called while encoding.
        most: maximum number of Gaussians in a tile; children of one parent stay together.
        force: whether existing files may be replaced.
        spz_version: 3 or 2.

    Returns:
        The number of written Gaussians per level.

    Raises:
        SceneError: if a file cannot be written.
    """
    warn_of_losses(format_to_write(".spz"), levels[0], folder)
    tops = cells(levels, parents, most)
    # By default, CesiumJS refines a tile at an error of 16 pixels.
    errors = [16.0 * size for size in itertools.accumulate(pixel_sizes, max)]
    counts = [0] * len(levels)
    number = itertools.count()

    def tile(cell: Cell) -> dict[str, Any]:
        scene = levels[cell.level][cell.rows]
        index = next(number)
        progress("writing tiles", sum(counts) / sum(map(len, levels)))
        low, high = _box(scene)
        x, y, z = (0.5 * (low + high)).tolist()
        name = f"tiles/{cell.level}_{index}.glb"
        data = encode_tile(scene.at_offset((x, y, z)), spz_version)
        with replacing(beside / name, len(data)) as place:
            place.write_bytes(data)
        counts[cell.level] += len(scene)
        children = [tile(child) for child in cell.children]
        error = errors[cell.level] if children else 0.0
        return {**_node(torch.stack([low, high]), children, error), "content": {"uri": name}}

    own_files = rf"{re.escape(TILESET)}|tiles"
    with replacing_folder(folder, TILESET, own_files, force) as beside:
        root = _node(None, [tile(top) for top in tops], max(errors))
        root["geometricError"] = max(
            root["geometricError"], 2 * sum(root["boundingVolume"]["box"][3::4])
        )
        extensions = {
            name: list(TILE_EXTENSIONS) for name in ("extensionsUsed", "extensionsRequired")
        }
        tileset = {
            "asset": {
                "version": "1.1",
                "generator": "pointsplat-ns",
                "extras": {EXTRAS: {"up": levels[0].up}},
            },
            "extensionsUsed": ["3DTILES_content_gltf"],
            "extensions": {"3DTILES_content_gltf": extensions},
            "geometricError": root["geometricError"],
            "root": {"transform": matrix.T.flatten().tolist(), "refine": "REPLACE", **root},
        }
        (beside / TILESET).write_text(json.dumps(tileset, separators=(",", ":")), "utf-8")
    return counts


def _box(scene: Gaussians) -> tuple[Tensor, Tensor]:
    """Corners of the box of all means, with a margin of three times the median size. A box of the
    largest Gaussians would make viewers refine distant tiles."""
    margin = 3 * typical_sizes(scene).median()
    return scene.means.double().amin(dim=0) - margin, scene.means.double().amax(dim=0) + margin


def _node(corners: Tensor | None, children: list[dict[str, Any]], error: float) -> dict[str, Any]:
    """A tile without content, with the box around its own corners (2, 3) and its children."""
    child_boxes = [child["boundingVolume"]["box"] for child in children]
    boxes = torch.tensor(child_boxes, **DOUBLES).reshape(-1, 12)
    middle = boxes[:, :3]
    half = boxes[:, 3::4]
    points = torch.cat([middle - half, middle + half, *([] if corners is None else [corners])])
    low, high = points.aminmax(dim=0)
    axes = torch.diag(0.5 * (high - low)).flatten().tolist()
    node = {
        "boundingVolume": {"box": [*(0.5 * (low + high)).tolist(), *axes]},
        "geometricError": error,
    }
    return {**node, "children": children} if children else node
