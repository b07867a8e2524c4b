"""The cells of one scene: what was measured, by which command and version, kept in a journal."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import one_line
from pointsplat_ns.pruning.scores import log_volume
from pointsplat_ns.tables.scene import TableOptions, TableScene
from pointsplat_ns.tables.ways import FIGURE_CELLS
from pointsplat_ns.tradeoff.journal import Form, check_types, restored_point
from pointsplat_ns.tradeoff.points import Point

CELLS = "cells.json"

FORM = Form("pointsplat-tables-cells", 1, "cells", "a scene's tables")

OPACITY_BINS = 40
"""Equal bins of opacity, from 0 to 1."""

VOLUME_SPAN = (-20.0, 4.0)
"""Decades of volume, scene units cubed, that bins cover; what is smaller or larger counts in the first or the last."""

VOLUME_BINS = 48


@dataclass(frozen=True)
class Cell:
    """One scene, made smaller in one way, measured."""

    way: str
    """Name of the way; see :mod:`~pointsplat_ns.tables.ways`."""
    point: Point
    """What was measured. Its key is the cell's, its command measures the cell again."""
    made_with: str
    """What it was made with besides the package: weights, another program, steps of fine-tuning."""
    seed: int
    version: str
    """Of the package."""
    commit: str
    """Of its source, with ``+`` where it was changed; empty if that is not known."""
    opacities: tuple[int, ...] | None = None
    """Number of Gaussians in each bin of opacity; None for cells that are not in Figure 4."""
    volumes: tuple[int, ...] | None = None
    """And of the logarithm of the volume."""


@dataclass(frozen=True)
class About:
    """What the cells of a scene have in common, for the reader."""

    name: str
    path: str
    dataset: str
    group: str
    origin: str
    """Where the views came from that scenes are judged in."""
    machine: str
    views: int
    """Their number."""
    width: int
    height: int


def identity(scene: TableScene, options: TableOptions, machine: str) -> dict[str, str | int]:
    """What all cells of a scene have in common: they can be compared with one another."""
    return {
        "file": scene.sha256,
        "machine": machine,
        "most views": options.views,
        "largest side": options.side,
        "most scoring views": options.scoring_views,
    }


class CellJournal:
    """The cells of one scene, on disk as soon as they are measured.

    Args:
        folder: of all tables; the scene has a folder in it.
        name: of the scene.

    Raises:
        SceneError: if there is a journal that cannot be read.
    """

    def __init__(self, folder: Path, name: str):
        self.path = folder / name / CELLS
        self.about: About | None = None
        self.cells: dict[tuple[str, float], Cell] = {}
        """By way and share."""
        self._of: dict[str, Any] = {}
        if self.path.exists():
            self._of, cells = FORM.read(self.path, _cell)
            self.about = _about(self._of, self.path)
            self.cells = {(cell.way, cell.point.share): cell for cell in cells}

    def check(self, wanted: Mapping[str, str | int]) -> None:
        """Check that cells of an identity may stand beside those that are there.

        Raises:
            SceneError: if those are of another scene, other views or another machine.
        """
        if self._of:
            FORM.check(self.path, self._of, wanted)

    def add(self, cell: Cell, about: About, of: Mapping[str, str | int]) -> None:
        """Take a cell in, in the place of an older one, and write all.

        Args:
            cell: what was measured.
            about, of: what the reader is told of the scene, and its identity.

        Raises:
            SceneError: if they cannot be written.
        """
        self.about, self._of = about, {**of, **vars(about)}
        self.cells[(cell.way, cell.point.share)] = cell
        FORM.write(self.path, self._of, list(self.cells.values()))

    def regroup(self, group: str) -> None:
        """Put a scene of which there are cells into another group.

        Raises:
            SceneError: if that cannot be written.
        """
        if self.about is not None and self.about.group != group:
            self.about = dataclasses.replace(self.about, group=group)
            self._of |= vars(self.about)
            FORM.write(self.path, self._of, list(self.cells.values()))


def distributions(scene: Gaussians, way: str, share: float) -> tuple[tuple[int, ...] | None, tuple[int, ...] | None]:
    """Numbers of Gaussians in the bins of opacity and of volume, for cells that Figure 4 shows; else None twice."""
    if (way, share) not in FIGURE_CELLS:
        return None, None
    usable = scene[scene.usable()]
    volumes = (log_volume(usable) / math.log(10)).clamp(*VOLUME_SPAN)
    return _counts(usable.alphas, OPACITY_BINS, (0.0, 1.0)), _counts(volumes, VOLUME_BINS, VOLUME_SPAN)


def _counts(values: Tensor, bins: int, span: tuple[float, float]) -> tuple[int, ...]:
    counts = torch.histc(values.double().flatten().cpu(), bins=bins, min=span[0], max=span[1])
    return tuple(int(count) for count in counts)


def _cell(values: dict[str, Any]) -> Cell:
    """A cell from what :func:`dataclasses.asdict` made of it.

    Raises:
        ValueError, TypeError, KeyError: if it is none.
    """
    bins = {name: None if values[name] is None else tuple(values[name]) for name in ("opacities", "volumes")}
    cell = Cell(**{**values, **bins, "point": restored_point(values["point"])})
    check_types(cell)
    for counts, number in ((cell.opacities, OPACITY_BINS), (cell.volumes, VOLUME_BINS)):
        if counts is not None and len(counts) != number:
            raise ValueError(f"{len(counts)} bins in place of {number}")
    return cell


def _about(of: dict[str, Any], path: Path) -> About:
    try:
        about = About(**{field.name: of[field.name] for field in dataclasses.fields(About)})
        check_types(about)
    except (KeyError, ValueError) as error:
        raise SceneError(
            f"{path}: not the cells of a scene's tables ({one_line(error)}); name another folder, or start over with "
            "--force"
        ) from error
    return about
