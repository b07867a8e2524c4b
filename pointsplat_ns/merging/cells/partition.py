"""Divides a file of Gaussians into cells: parts of a space-filling curve with equally many Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import Cube, bulk_cube, curve_keys, unit_cells
from pointsplat_ns.io.files import logger
from pointsplat_ns.io.ply import PlyRows
from pointsplat_ns.io.usable import usable_part
from pointsplat_ns.merging.cells.scratch import Scratch
from pointsplat_ns.system.tensors import INDICES


@dataclass(frozen=True)
class CellSettings:
    """Sizes of what merging by cells reads and thins."""

    rows_at_once: int = 1 << 17
    """Number of rows that are read at once."""
    overview: int = 1 << 18
    """Number of Gaussians of the thinned scene, about as many as are drawn to count covered pixels."""
    finished_parts: int = 4
    """Number of parts of the curve that are merged by themselves to find the finish of the whole. In five scenes, an
    eighth of a scene at a time, their mean factor differs from that of the whole by 0.02 at most. A thinned scene needs
    smaller factors than the whole."""
    finished_part: int = 1 << 18
    """Number of Gaussians in each of these parts."""


CELLS = CellSettings()

_ROW_BITS = 21
"""Bits of a place on the curve that hold the order in the file: Gaussians at one position can be parted too."""


@dataclass(frozen=True, eq=False)
class Cells:
    """A scene in cells."""

    scratch: Scratch
    sample: Gaussians  # [m] every so many-th Gaussian of the file, along the curve
    keys: Tensor  # [m] int64, of the sample on the curve, ascending
    cube: Cube
    """What the curve fills."""
    counts: tuple[int, ...]
    """Number of Gaussians in each cell."""

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def count(self) -> int:
        """Number of Gaussians in all cells."""
        return sum(self.counts)

    def read(self, cell: int) -> Gaussians:
        """The Gaussians of a cell, in the order of the file."""
        path, width = self.scratch.folder / _name(cell), _width(self.sample)
        scene = self.sample.map(lambda values: values.new_empty(self.counts[cell], *values.shape[1:]))
        with path.open("rb") as stream:
            for start in range(0, len(scene), CELLS.rows_at_once):
                count = min(CELLS.rows_at_once, len(scene) - start)
                table = np.fromfile(stream, "<f4", count * width)
                if len(table) < count * width:
                    raise SceneError(f"{path}: truncated; remove the folder and start again")
                columns = torch.from_numpy(table.reshape(count, width).astype(np.float32, copy=False))
                for (_, into), values in zip(scene.items(), columns.split(_widths(scene), dim=1), strict=True):
                    into[start : start + count] = values.reshape(count, *into.shape[1:])
        return scene

    def keys_of(self, scene: Gaussians) -> Tensor:
        """Places (n,) int64 of Gaussians on the curve."""
        return torch.cat([curve_keys(unit_cells(means, self.cube)) for means in scene.means.split(CELLS.rows_at_once)])


def divided(rows: PlyRows, most: int, scratch: Scratch, report: Callable[[float], None]) -> Cells:
    """Write a file of each cell.

    Args:
        rows: the scene. Gaussians that cannot be drawn are dropped, and counted in a warning.
        most: largest number of Gaussians in a cell, about.
        scratch: where files are.
        report: called with the share done.

    Raises:
        SceneError: if the file cannot be read, or no Gaussian of the sample can be drawn.
    """
    picked = range(0, rows.count, -(-rows.count // CELLS.overview))
    some = rows.pick(picked)
    usable = some.usable()
    if not bool(usable.any()):
        raise SceneError(
            f"{rows.path}: none of {len(some)} Gaussians in it can be drawn: all have NaN or infinite values"
        )
    numbers = torch.tensor(picked, **INDICES)[usable]
    some = usable_part(some)
    cube = bulk_cube(some.means)
    keys = curve_keys(unit_cells(some.means, cube))
    places = _places(keys, numbers, rows.count).sort().values
    cells = -(-rows.count // most)
    borders = places[torch.arange(1, cells, **INDICES) * len(places) // cells]

    def write() -> dict[str, Tensor]:
        counts = torch.zeros(cells, **INDICES)
        with ExitStack() as stack:
            files = [stack.enter_context((scratch.folder / _name(cell)).open("wb")) for cell in range(cells)]
            for start in range(0, rows.count, CELLS.rows_at_once):
                piece = rows.read(start, min(start + CELLS.rows_at_once, rows.count))
                numbers = torch.arange(start, start + len(piece), **INDICES)[piece.usable()]
                piece = usable_part(piece)
                own = curve_keys(unit_cells(piece.means, cube))
                cell = torch.searchsorted(borders, _places(own, numbers, rows.count), right=True)
                table = torch.cat([values.flatten(1) for values in piece.tensors()], dim=1)
                sizes = torch.bincount(cell, minlength=cells)
                counts += sizes
                parts = table[cell.argsort(stable=True)].split(sizes.tolist())
                for file, part in zip(files, parts, strict=True):
                    part.numpy().astype("<f4", copy=False).tofile(file)
                report(min(1.0, (start + CELLS.rows_at_once) / rows.count))
        dropped = rows.count - int(counts.sum())
        if dropped:
            logger.warning("%s: dropped %d of %d Gaussians with NaN or infinite values", rows.path, dropped, rows.count)
        return {"counts": counts}

    counts = scratch.tensors("counts", write)["counts"]
    order = keys.argsort(stable=True)
    return Cells(scratch, some[order], keys[order], cube, tuple(counts.tolist()))


def _places(keys: Tensor, numbers: Tensor, count: int) -> Tensor:
    """Places (n,) int64 on the curve, and of those at one position in the file, from keys on the curve and the numbers
    of ``count`` rows."""
    return ((keys >> 18) << _ROW_BITS) | (numbers * (1 << _ROW_BITS) // count)


def _name(cell: int) -> str:
    return f"cell_{cell:04d}.rows"


def _widths(scene: Gaussians) -> list[int]:
    return [values[:0].flatten(1).shape[1] for values in scene.tensors()]


def _width(scene: Gaussians) -> int:
    return sum(_widths(scene))
