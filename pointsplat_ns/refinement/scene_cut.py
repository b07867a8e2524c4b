"""Cuts scenes into pieces by planes, for a network to learn from many small scenes."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.system.tensors import DOUBLES, INDICES


@dataclass(frozen=True, eq=False)
class SceneCut:
    """A tree of planes that divides space into :attr:`count` pieces.

    Node i sends the positions whose coordinate along ``directions[i]`` is at most ``thresholds[i]``
    to ``children[i, 0]``, and the others to ``children[i, 1]``: another node, or, below 0, the
    piece of number ``-1 - child``.
    """

    directions: Tensor  # [M, 3] float64, unit
    thresholds: Tensor  # [M] float64, scene units
    children: Tensor  # [M, 2] int64
    count: int

    def pieces_of(self, means: Tensor) -> Tensor:
        """The piece of each position (N, 3), finite. # [N] int64 in [0, count)"""
        means = means.detach().double().cpu()
        place = torch.zeros(len(means), **INDICES)
        if not len(self.thresholds):
            return place
        inside = torch.arange(len(means), **INDICES)
        while len(inside):
            node = place[inside]
            along = (means[inside] * self.directions[node]).sum(dim=1)
            place[inside] = self.children[node, (along > self.thresholds[node]).long()]
            inside = inside[place[inside] >= 0]
        return -1 - place


def cut_scene(means: Tensor, most: int, seed: int = 0) -> SceneCut:
    """Planes that cut positions into pieces of at most ``most``, each plane through the median
    across the longest side.

    The axes that planes are perpendicular to are turned at random. Coincident positions stay
    together, also where they are more than ``most``.

    Args:
        means: (N, 3), finite, at least one.
        most: largest number of positions of a piece, at least 1.
        seed: determines the axes.

    Example:
        >>> import torch
        >>> line = torch.arange(8.0)[:, None] * torch.ones(3)
        >>> cut = cut_scene(line, most=4)
        >>> cut.count, cut.pieces_of(line).bincount().tolist()
        (2, [4, 4])
    """
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(1, 4, generator=generator, **DOUBLES)
    axes = rotation_matrices(quat)[0]
    along = means.detach().double().cpu() @ axes.T  # [N, 3]
    directions: list[Tensor] = []
    thresholds: list[float] = []
    children: list[list[int]] = []
    pieces = 0

    def build(rows: Tensor) -> int:
        """Number of the node, or piece, of these rows."""
        nonlocal pieces
        parts = _halves(along[rows]) if len(rows) > most else None
        if parts is None:
            pieces += 1
            return -pieces
        axis, threshold, upper = parts
        node = len(thresholds)
        directions.append(axes[axis])
        thresholds.append(threshold)
        children.append([0, 0])
        children[node] = [build(rows[~upper]), build(rows[upper])]
        return node

    build(torch.arange(len(along), **INDICES))
    return SceneCut(
        directions=torch.stack(directions) if directions else torch.zeros(0, 3, **DOUBLES),
        thresholds=torch.tensor(thresholds, **DOUBLES),
        children=torch.tensor(children, **INDICES).view(-1, 2),
        count=pieces,
    )


def _halves(along: Tensor) -> tuple[int, float, Tensor] | None:
    """Axis, threshold and mask of the upper half of positions (n, 3), across the axis along which
    nine tenths of them spread most; None if all coincide."""
    n = len(along)
    trim = n // 20
    low = along.kthvalue(trim + 1, dim=0).values
    high = along.kthvalue(n - trim, dim=0).values
    spread = high - low
    if not bool((spread > 0).any()):
        low, high = along.aminmax(dim=0)
        spread = high - low
    axis = int(spread.argmax())
    if not float(spread[axis]) > 0:
        return None
    values = along[:, axis]
    threshold = float(values.median())
    if threshold >= float(values.max()):  # half or more coincide at the upper end
        threshold = float(values[values < threshold].max())
    upper = values > threshold
    # between the two halves, so that rounding puts no position on the other side
    between = 0.5 * (float(values[~upper].max()) + float(values[upper].min()))
    return axis, between, upper
