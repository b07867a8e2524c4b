"""Divides nested levels into cells: the descendants of neighbours in a coarser level."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import torch
from torch import Tensor

from pointsplat_ns.scene.formats.coding import morton_order
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.tensors import FLOATS, INDICES

Parts: TypeAlias = "Tensor | tuple[Parts, Parts]"
"""Indices of points, or two such parts."""


@dataclass(eq=False)
class Cell:
    """A part of one level. Its children together are the same part of the next finer level."""

    level: int
    """Index of the level; 0 is the finest."""
    rows: Tensor
    """Indices of Gaussians of the level, in Morton order."""
    children: list[Cell] = field(default_factory=list)


def halved(
    points: Tensor, weights: Tensor, most: int, extent: float = math.inf, least: int = 0
) -> Parts:
    """Cut points (N, 3) recursively at the middle of their weight (N,) along the longest side.

    A part is cut if it has more than one point, and a larger weight than ``most``, or a side longer
    than ``extent`` and a larger weight than ``least``.
    """

    def split(members: Tensor) -> Parts:
        part = points[members]
        weight = weights[members]
        total = int(weight.sum())
        sides = part.amax(dim=0) - part.amin(dim=0) if len(members) else torch.zeros(3, **FLOATS)
        too_wide = float(sides.max()) > extent and total > least
        if len(members) > 1 and (total > most or too_wide):
            order = part[:, int(sides.argmax())].argsort(stable=True)
            half = int((weight[order].cumsum(0) < total / 2).sum()) + 1
            cut = min(max(half, 1), len(members) - 1)
            return split(members[order[:cut]]), split(members[order[cut:]])
        return members

    return split(torch.arange(len(points), **INDICES))


def leaves(parts: Parts) -> list[Tensor]:
    """The uncut parts, in order."""
    if isinstance(parts, Tensor):
        return [parts]
    return [leaf for part in parts for leaf in leaves(part)]


def grouped(scene: Gaussians, group: Tensor, count: int) -> tuple[Tensor, ...]:
    """Indices of the Gaussians per group, for ``count`` groups, in Morton order; -1 means no
    group."""
    order = morton_order(scene)
    order = order[group[order] >= 0]
    sizes = torch.bincount(group[order], minlength=count)
    return order[group[order].argsort(stable=True)].split(sizes.tolist())


def cells(levels: Sequence[Gaussians], parents: Sequence[Tensor], most: int) -> list[Cell]:
    """Cells of the coarsest level, with the cells of all finer levels below them.

    Args:
        levels: the finest first.
        parents: for all levels but the last, index (M,) of each Gaussian's parent in the next
            level; -1 for dropped Gaussians.
        most: maximum number of Gaussians in a cell; children of one parent stay together.
    """
    top = Cell(len(levels), torch.arange(len(levels[-1]), **INDICES))
    above = [top]
    coarser = [*zip(levels[1:], parents, strict=True), (levels[-1], top.rows)]
    for level in reversed(range(len(levels))):
        scene, parent = coarser[level]
        weights = torch.bincount(parent[parent >= 0], minlength=len(scene))
        number = torch.full((len(scene),), -1, **INDICES)
        level_cells: list[Cell] = []
        for cell in above:
            for leaf in leaves(halved(scene.means[cell.rows], weights[cell.rows], most)):
                number[cell.rows[leaf]] = len(level_cells)
                level_cells.append(Cell(level, leaf))
                cell.children.append(level_cells[-1])
        group = torch.where(parent >= 0, number[parent], -1)
        for cell, rows in zip(
            level_cells, grouped(levels[level], group, len(level_cells)), strict=True
        ):
            cell.rows = rows
        above = level_cells
    return top.children
