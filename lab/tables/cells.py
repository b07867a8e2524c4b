"""The cells of one scene: measurements with their commands and versions, in a journal."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from lab.tables.journal import Form
from lab.tables.scene import TableOptions, TableScene
from lab.tables.ways import WAYS
from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import one_line
from pointsplat_ns.pruning.scores import log_volume
from pointsplat_ns.tradeoff.points import Point, check_types, restored_point


@dataclass(frozen=True)
class TableFiles:
    """Names of files in the folder of all tables."""

    cells: str = "cells.json"
    """The journal of a scene, in a folder of the scene's own."""
    markdown: str = "tables.md"
    latex: str = "tables.tex"
    json: str = "tables.json"
    figure: str = "figure4.png"

    @property
    def results(self) -> tuple[str, ...]:
        """All but the journals."""
        return (self.markdown, self.latex, self.json, self.figure)


TABLE_FILES = TableFiles()

CELLS_FORM = Form("pointsplat-tables-cells", 2, "cells", "a scene's tables")


@dataclass(frozen=True)
class HistogramBins:
    """Bins of the distributions in Figure 4."""

    opacity: int = 40
    """Number of equal bins of opacity, from 0 to 1."""
    volume: int = 48
    """Number of equal bins of log10 of the volume."""
    volume_span: tuple[float, float] = (-20.0, 4.0)
    """Range of log10 of the volume, scene units cubed; values outside count in the first or the last bin."""

    @property
    def opacity_edges(self) -> np.ndarray:
        return np.linspace(0.0, 1.0, self.opacity + 1)

    @property
    def volume_edges(self) -> np.ndarray:
        return np.linspace(*self.volume_span, self.volume + 1)


BINS = HistogramBins()


@dataclass(frozen=True)
class Cell:
    """The measurement of one scene, made smaller in one way."""

    way: str
    """Name of the way; see :mod:`~lab.tables.ways`."""
    point: Point
    """Figures. Its key is the key of the cell, and its command measures the cell again."""
    made_with: str
    """Tools besides the package: weights, another program, steps of fine-tuning."""
    seed: int
    version: str
    """Version of the package."""
    commit: str
    """Commit of its source, with ``+`` if it has changes; empty if it is not known."""
    opacities: tuple[int, ...] | None = None
    """Number of Gaussians in each bin of opacity; None for cells that are not in Figure 4."""
    volumes: tuple[int, ...] | None = None
    """The same for bins of log10 of the volume."""


@dataclass(frozen=True)
class About:
    """Facts on a scene and its views, for the reader."""

    name: str
    path: str
    dataset: str
    group: str
    origin: str
    """Origin of the views that scenes are judged in."""
    machine: str
    views: int
    """Number of views."""
    width: int
    height: int
    differs: str = "measured by an older version"
    """Differences from the paper's protocol; empty if there are none."""


def identity(scene: TableScene, options: TableOptions, machine: str) -> dict[str, str | int]:
    """Values that all cells of a scene have in common, so that they can be compared."""
    return {
        "file": scene.sha256,
        "machine": machine,
        "most views": options.views,
        "largest side": options.side,
        "most scoring views": options.scoring_views,
    }


class CellJournal:
    """The cells of one scene, in its folder in the folder of all tables, written as soon as they are measured. Raises
    SceneError if the scene's journal cannot be read."""

    def __init__(self, folder: Path, name: str):
        self.path = folder / name / TABLE_FILES.cells
        self.about: About | None = None
        self.cells: dict[tuple[str, float], Cell] = {}
        """Cells by way and share."""
        self._of: dict[str, Any] = {}
        if self.path.exists():
            self._of, cells = CELLS_FORM.read(self.path, _cell)
            self.about = _about(self._of, self.path)
            self.cells = {(cell.way, cell.point.share): cell for cell in cells}

    def check(self, wanted: Mapping[str, str | int]) -> None:
        """Raise a SceneError if existing cells are of another scene, other views or another machine than ``wanted``."""
        if self._of:
            CELLS_FORM.check(self.path, self._of, wanted)

    def add(self, cell: Cell, about: About, of: Mapping[str, str | int]) -> None:
        """Add a cell, or replace an older one, and write all cells, with facts on the scene for the reader and its
        identity."""
        self.about, self._of = about, {**of, **vars(about)}
        self.cells[(cell.way, cell.point.share)] = cell
        CELLS_FORM.write(self.path, self._of, list(self.cells.values()))

    def regroup(self, group: str) -> None:
        """Move a scene with cells to another group."""
        if self.about is not None and self.about.group != group:
            self.about = dataclasses.replace(self.about, group=group)
            self._of |= vars(self.about)
            CELLS_FORM.write(self.path, self._of, list(self.cells.values()))


def distributions(scene: Gaussians, way: str, share: float) -> tuple[tuple[int, ...] | None, tuple[int, ...] | None]:
    """Numbers of Gaussians in the bins of opacity and of volume, for cells of Figure 4; else None twice."""
    if (way, share) not in {(shown.name, kept) for shown, kept in WAYS.figure_4}:
        return None, None
    usable = scene[scene.usable()]
    volumes = (log_volume(usable) / math.log(10)).clamp(*BINS.volume_span)
    return _counts(usable.alphas, BINS.opacity, (0.0, 1.0)), _counts(volumes, BINS.volume, BINS.volume_span)


def _counts(values: Tensor, bins: int, span: tuple[float, float]) -> tuple[int, ...]:
    counts = torch.histc(values.double().flatten().cpu(), bins=bins, min=span[0], max=span[1])
    return tuple(int(count) for count in counts)


def _cell(values: dict[str, Any]) -> Cell:
    """The inverse of :func:`dataclasses.asdict` for a cell. Errors are those of Python if the values are not those of a
    cell."""
    bins = {name: None if values[name] is None else tuple(values[name]) for name in ("opacities", "volumes")}
    cell = Cell(**{**values, **bins, "point": restored_point(values["point"])})
    check_types(cell)
    for counts, number in ((cell.opacities, BINS.opacity), (cell.volumes, BINS.volume)):
        if counts is not None and len(counts) != number:
            raise ValueError(f"{len(counts)} bins in place of {number}")
    return cell


def _about(of: dict[str, Any], path: Path) -> About:
    try:
        about = About(**{field.name: of[field.name] for field in dataclasses.fields(About) if field.name in of})
        check_types(about)
    except (TypeError, ValueError) as error:
        raise SceneError(
            f"{path}: not the cells of a scene's tables ({one_line(error)}); name another folder, or start over with "
            "--force"
        ) from error
    return about
