"""The tiles that each Gaussian touches, by compiled kernels (``tiles.cpp``), as
:mod:`~pointsplat_ns.rasterizer.ellipses` finds them."""

from __future__ import annotations

import math
from typing import cast

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.compiled.blending import table_of
from pointsplat_ns.rasterizer.constants import SLACK
from pointsplat_ns.rasterizer.ellipses import Ellipses, Grid, TileList
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, on_threads
from pointsplat_ns.system.tensors import INDICES


def ellipses_of(means2d: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor, order: Tensor, grid: Grid) -> Ellipses:
    """As :func:`pointsplat_ns.rasterizer.ellipses.ellipses_of`."""
    table = table_of(means2d, cov2d, det, opacities, means2d[:, :0])
    boxes = torch.empty(len(order), 4, dtype=torch.int32, device="cpu")
    on_threads(
        len(order) >= SEVERAL, KERNELS.library.pointsplat_boxes, table, len(order), math.log2(grid.alpha_min), SLACK,
        grid.rows, grid.columns, boxes,
    )  # fmt: skip
    return Ellipses(order, table, boxes)


def listed(
    ellipses: Ellipses,
    grid: Grid,
    top: int,
    bottom: int,
    strips: int,
    ids: Tensor | None = None,
    counts: Tensor | None = None,
    most_pairs: float = math.inf,
) -> tuple[Tensor, Tensor, Tensor | None] | None:
    """The Gaussians that touch the tiles of the rows from ``top`` on before ``bottom``.

    Args:
        ellipses: M Gaussians.
        grid: of the image.
        top, bottom: rows of tiles.
        strips: number of these rows that each Gaussian reaches, summed.
        ids: int32, row of the table of each box, if it is not the box's own.
        counts: (M,) int64 zeros, to which the pairs of each Gaussian are added, in depth order.
        most_pairs: largest number P of pairs of Gaussian and tile.

    Returns:
        Rows of the table by tile, front to back (P,), where those of each tile start (tiles + 1,), and, given
        ``counts``, the places of :class:`TileList`, all int64; None if the pairs are too many.
    """
    offsets = torch.zeros((bottom - top) * grid.columns + 1, **INDICES)
    task = KERNELS.structs["Listing"](
        table=ellipses.shapes, boxes=ellipses.boxes, ids=ids, order=ellipses.order, count=len(ellipses.order),
        stride=ellipses.shapes.shape[1], height=grid.height, columns=grid.columns, top=top, bottom=bottom,
        log2_alpha_min=math.log2(grid.alpha_min), slack=SLACK, offsets=offsets, counts=counts,
        strips=torch.empty(strips, 2, dtype=torch.int32, device="cpu"),
    )  # fmt: skip
    KERNELS.library.pointsplat_count(task)
    offsets = torch.cumsum(offsets, 0)
    total = int(offsets[-1])
    if total > most_pairs:
        return None
    gaussians, places = torch.empty(total, **INDICES), None if counts is None else torch.empty(total, **INDICES)
    task.fill(offsets=offsets, gaussians=gaussians, places=places)
    KERNELS.library.pointsplat_list(task)
    return gaussians, offsets, places


def pairs_of(ellipses: Ellipses, grid: Grid, top: int, bottom: int) -> TileList:
    """As :func:`pointsplat_ns.rasterizer.ellipses.pairs_of`."""
    first, last = ellipses.boxes[:, 0].clamp_min(top), ellipses.boxes[:, 1].clamp_max(bottom - 1)
    counts = torch.zeros_like(ellipses.order)
    strips = int((last - first + 1).clamp_min_(0).sum())
    found = listed(ellipses, grid, top, bottom, strips, counts=counts)
    gaussians, offsets, places = cast(tuple[Tensor, Tensor, Tensor], found)
    return TileList(gaussians, offsets, places, counts, ellipses.order, top)
