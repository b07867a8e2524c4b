"""Divides a scene larger than memory into cells: parts of a space-filling curve of equal counts.

Each cell has a file in a folder of finished steps.
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.transforms import Cube, bulk_cube, curve_keys, unit_cells
from pointsplat_ns.pruning.merging.state import drawable, sampled_step
from pointsplat_ns.rendering.constants import ALPHA_MIN
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import PlyRows
from pointsplat_ns.scene.usable import usable_part
from pointsplat_ns.system.files import (
    logger,
    one_line,
    read_text,
    require_space,
    write_json,
    write_tensors,
)
from pointsplat_ns.system.outputs import is_own_file
from pointsplat_ns.system.tensors import INDICES

ROWS_AT_ONCE = 1 << 17
"""Number of rows per read."""


class Scratch:
    """A folder whose files are complete or missing.

    Args:
        folder: created if missing. If it contains steps of other work, or a symbolic link, all its
            content is removed; a link in its place is removed too.
        work: JSON description of the work: all data that its steps depend on.
        size: total bytes of all steps; they must be free for new work.

    Raises:
        SceneError: if the folder cannot be used, or the disk has too little space.
    """

    def __init__(self, folder: Path, work: Mapping[str, object], size: int = 0):
        self.folder = folder
        known = self.description
        try:
            same = not folder.is_symlink() and all(map(is_own_file, folder.iterdir()))
            same = same and json.loads(read_text(known)) == work
        except (OSError, ValueError, RecursionError):
            same = False
        try:
            if folder.is_symlink():
                folder.unlink()
            if not same and folder.exists():
                shutil.rmtree(folder)
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise SceneError(
                f"{folder}: cannot be used ({error.strerror or one_line(error)})"
            ) from error
        if not same:
            with self.left_if_useful():
                require_space(folder, folder, size)
                write_json(work, known)

    @property
    def description(self) -> Path:
        """File with the description of the work."""
        return self.folder / "work.json"

    @contextmanager
    def left_if_useful(self) -> Iterator[None]:
        """After an error, remove the folder if no step is finished."""
        try:
            yield
        except BaseException:
            if not any(path.suffix == ".safetensors" for path in self.folder.glob("[!.]*")):
                self.remove()
            raise

    def has(self, name: str) -> bool:
        """Whether a step with tensors is finished."""
        return self._path(name).is_file()

    def make(self, name: str, make: Callable[[], Mapping[str, Tensor]]) -> None:
        """Run a step that returns tensors, unless it is finished."""
        if not self.has(name):
            write_tensors(self._path(name), make(), {})

    def tensors(self, name: str, make: Callable[[], Mapping[str, Tensor]]) -> dict[str, Tensor]:
        """Tensors of a step, which runs unless it is finished."""
        self.make(name, make)
        return self.known(name)

    def known(self, name: str) -> dict[str, Tensor]:
        """Tensors of a finished step. Raises SceneError if its file is missing or damaged."""
        from safetensors import SafetensorError
        from safetensors.torch import load_file

        try:
            return load_file(self._path(name))
        except (OSError, SafetensorError) as error:
            raise SceneError(
                f"{self.folder}: damaged ({one_line(error)}); remove it and start again"
            ) from error

    def drop(self, name: str) -> None:
        """Remove the tensors of a step, if it is finished."""
        self._path(name).unlink(missing_ok=True)

    def remove(self) -> None:
        """Remove the folder."""
        shutil.rmtree(self.folder, ignore_errors=True)

    def _path(self, name: str) -> Path:
        return self.folder / f"{name}.safetensors"


@dataclass(frozen=True, eq=False)
class Cells:
    """A scene divided into cells."""

    scratch: Scratch
    kind: Gaussians  # [0] with the dtypes, SH degree and traits of all
    cube: Cube
    """The cube of the space-filling curve."""
    counts: tuple[int, ...]
    """Number of Gaussians in each cell."""
    drawable: tuple[int, ...]
    """Number of Gaussians in each cell that are opaque enough to be drawn."""

    def __len__(self) -> int:
        return len(self.counts)

    @property
    def count(self) -> int:
        """Number of Gaussians in all cells."""
        return sum(self.counts)

    def read(self, cell: int) -> Gaussians:
        """The Gaussians of a cell, in file order."""
        path = self.scratch.folder / _name(cell)
        widths = [values.flatten(1).shape[1] for values in self.kind.tensors()]
        scene = self.kind.map(lambda values: values.new_empty(self.counts[cell], *values.shape[1:]))
        with path.open("rb") as stream:
            for start in range(0, len(scene), ROWS_AT_ONCE):
                count = min(ROWS_AT_ONCE, len(scene) - start)
                table = np.fromfile(stream, "<f4", count * sum(widths))
                if len(table) < count * sum(widths):
                    raise SceneError(f"{path}: truncated; remove the folder and start again")
                columns = torch.from_numpy(table.reshape(count, -1).astype(np.float32, copy=False))
                for (_, into), values in zip(
                    scene.items(), columns.split(widths, dim=1), strict=True
                ):
                    into[start : start + count] = values.reshape(count, *into.shape[1:])
        return scene

    def members(self, cell: int, k: int) -> tuple[Gaussians, Tensor]:
        """The Gaussians of a cell, and the indices (n,) of its participants along the curve, where
        the whole scene becomes ``k`` Gaussians."""
        scene = self.read(cell)
        members = drawable(scene, self.share(cell, k))
        keys = [
            curve_keys(unit_cells(scene.means[some], self.cube))
            for some in members.split(ROWS_AT_ONCE)
        ]
        return scene, members[torch.cat(keys).argsort(stable=True)]

    def starts(self, k: int) -> list[int]:
        """Number of members in all cells before each cell, and in total."""
        counts = (max(count, self.share(cell, k)) for cell, count in enumerate(self.drawable))
        return [0, *itertools.accumulate(counts)]

    def share(self, cell: int, k: int) -> int:
        """The cell's part of ``k`` Gaussians."""
        return -(-self.counts[cell] * k // self.count)


def divided(rows: PlyRows, most: int, scratch: Scratch, report: Callable[[float], None]) -> Cells:
    """Write a file of each cell.

    Args:
        rows: the scene. Gaussians that cannot be drawn are dropped, and counted in a warning.
        most: approximate maximum number of Gaussians in a cell.
        scratch: folder of the files.
        report: called with the share done.

    Raises:
        SceneError: if the file cannot be read, or no Gaussian of the sample can be drawn.
    """
    picked = range(0, rows.count, sampled_step(rows.count))
    some = rows.pick(picked)
    usable = some.usable()
    if not bool(usable.any()):
        raise SceneError(
            f"{rows.path}: none of {len(some)} sampled Gaussians can be drawn: all have NaN or "
            "infinite values"
        )
    numbers = torch.tensor(picked, **INDICES)[usable]
    some = usable_part(some)
    cube = bulk_cube(some.means[drawable(some, 1)])
    keys = curve_keys(unit_cells(some.means, cube))
    places = _places(keys, numbers, rows.count).sort().values
    cells = -(-rows.count // most)
    borders = places[torch.arange(1, cells, **INDICES) * len(places) // cells]

    def write() -> dict[str, Tensor]:
        counts, clear = torch.zeros(2, cells, **INDICES)
        with ExitStack() as stack:
            files = [
                stack.enter_context((scratch.folder / _name(cell)).open("wb"))
                for cell in range(cells)
            ]
            for start in range(0, rows.count, ROWS_AT_ONCE):
                piece = rows.read(start, min(start + ROWS_AT_ONCE, rows.count))
                numbers = torch.arange(start, start + len(piece), **INDICES)[piece.usable()]
                piece = usable_part(piece)
                own = curve_keys(unit_cells(piece.means, cube))
                cell = torch.searchsorted(borders, _places(own, numbers, rows.count), right=True)
                table = torch.cat([values.flatten(1) for values in piece.tensors()], dim=1)
                sizes = torch.bincount(cell, minlength=cells)
                counts += sizes
                clear += torch.bincount(cell[piece.alphas >= ALPHA_MIN], minlength=cells)
                parts = table[cell.argsort(stable=True)].split(sizes.tolist())
                for file, part in zip(files, parts, strict=True):
                    part.numpy().astype("<f4", copy=False).tofile(file)
                report(min(1.0, (start + ROWS_AT_ONCE) / rows.count))
        dropped = rows.count - int(counts.sum())
        if dropped:
            logger.warning(
                "%s: dropped %d of %d Gaussians with NaN or infinite values",
                rows.path,
                dropped,
                rows.count,
            )
        return {"counts": counts, "drawable": clear}

    counts = scratch.tensors("counts", write)
    return Cells(
        scratch,
        some[:0].map(torch.clone),
        cube,
        *(tuple(counts[name].tolist()) for name in ("counts", "drawable")),
    )


def _places(keys: Tensor, numbers: Tensor, count: int) -> Tensor:
    """Positions (n,) int64 along the curve, from keys on the curve and the row numbers of ``count``
    rows. The last 21 bits are the file order, so that even Gaussians at one position can be
    separated."""
    return ((keys >> 18) << 21) | (numbers * (1 << 21) // count)


def _name(cell: int) -> str:
    return f"cell_{cell:04d}.rows"
