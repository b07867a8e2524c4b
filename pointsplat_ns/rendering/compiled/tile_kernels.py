"""Tiles that Gaussians touch, with compiled kernels (``tiles.cpp``);
:mod:`~pointsplat_ns.rendering.ellipses` is the same in torch."""

from __future__ import annotations

import ctypes
import math
from typing import cast

import torch
from torch import Tensor

from pointsplat_ns.rendering.compiled.blending_kernels import inputs_of
from pointsplat_ns.rendering.constants import SLACK
from pointsplat_ns.rendering.ellipses import Ellipses, Grid, TileList
from pointsplat_ns.system.kernels import (
    ANY_POINTER,
    FLOAT_POINTER,
    INT32_POINTER,
    INT64_POINTER,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.tensors import INDICES


class ListingStruct(Struct):
    """``Listing`` of ``tiles.cpp``, which says what its members are."""

    members = {
        "table": FLOAT_POINTER,
        "stride": ctypes.c_int64,
        "order": INT64_POINTER,
        "count": ctypes.c_int64,
        "boxes": INT32_POINTER,
        "height": ctypes.c_int64,
        "rows": ctypes.c_int64,
        "columns": ctypes.c_int64,
        "top": ctypes.c_int64,
        "bottom": ctypes.c_int64,
        "log2_alpha_min": ctypes.c_float,
        "slack": ctypes.c_float,
        "strips": ANY_POINTER,
        "offsets": INT64_POINTER,
        "counts": INT64_POINTER,
        "gaussians": INT64_POINTER,
        "places": INT64_POINTER,
    }
    _fields_ = c_fields(members)


by_depth_kernel = Function("pointsplat_by_depth", FLOAT_POINTER, ctypes.c_int64, INT64_POINTER)
boxes_kernel = Function("pointsplat_boxes", ListingStruct, INT64_POINTER)
count_kernel = Function("pointsplat_count", ListingStruct)
list_kernel = Function("pointsplat_list", ListingStruct)


def by_depth(depths: Tensor) -> Tensor:
    """As :func:`pointsplat_ns.rendering.ellipses.by_depth`, for depths of at least 0."""
    order = torch.empty(len(depths), **INDICES)
    by_depth_kernel(depths, len(depths), order)
    return order


def ellipses_of(
    means2d: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor, order: Tensor, grid: Grid
) -> Ellipses:
    """As :func:`pointsplat_ns.rendering.ellipses.ellipses_of`."""
    return boxed(
        inputs_of(means2d, cov2d, det, opacities, means2d[:, :0], grid.alpha_min), order, grid
    )


def boxed(table: Tensor, order: Tensor, grid: Grid) -> Ellipses:
    """Ellipses of the Gaussians in the rows ``order``, (M,) int64, of a table, front to back."""
    found = Ellipses(order, table, torch.empty(len(order), 4, dtype=torch.int32, device="cpu"))
    on_threads(len(order) >= SEVERAL, boxes_kernel, _task(found, grid, 0, grid.rows))
    return found


def _task(ellipses: Ellipses, grid: Grid, top: int, bottom: int, **lists: Tensor | None) -> Struct:
    return ListingStruct(
        table=ellipses.shapes,
        stride=ellipses.shapes.shape[1],
        boxes=ellipses.boxes,
        order=ellipses.order,
        count=len(ellipses.order),
        height=grid.height,
        rows=grid.rows,
        columns=grid.columns,
        top=top,
        bottom=bottom,
        log2_alpha_min=math.log2(grid.alpha_min),
        slack=SLACK,
        **lists,
    )


def listed(
    ellipses: Ellipses,
    grid: Grid,
    top: int,
    bottom: int,
    taped: bool = True,
    most_pairs: float = math.inf,
) -> TileList | None:
    """As :func:`pointsplat_ns.rendering.ellipses.pairs_of`; without ``places`` and ``counts``,
    which only gradients need, unless ``taped``; None if there are more than ``most_pairs``
    pairs."""
    first = ellipses.boxes[:, 0].clamp_min(top)
    last = ellipses.boxes[:, 1].clamp_max(bottom - 1)
    strips = torch.empty(
        int((last - first + 1).clamp_min_(0).sum()), 2, dtype=torch.int32, device="cpu"
    )
    offsets = torch.zeros((bottom - top) * grid.columns + 1, **INDICES)
    counts = torch.zeros(len(ellipses.order) if taped else 0, **INDICES)
    task = _task(
        ellipses,
        grid,
        top,
        bottom,
        strips=strips,
        offsets=offsets,
        counts=counts if taped else None,
    )
    count_kernel(task)
    offsets = torch.cumsum(offsets, 0)
    total = int(offsets[-1])
    if total > most_pairs:
        return None
    gaussians = torch.empty(total, **INDICES)
    places = torch.empty(total if taped else 0, **INDICES)
    task.fill(offsets=offsets, gaussians=gaussians, places=places if taped else None)
    list_kernel(task)
    return TileList(gaussians, offsets, places, counts, ellipses.order, top)


def pairs_of(ellipses: Ellipses, grid: Grid, top: int, bottom: int) -> TileList:
    """As :func:`pointsplat_ns.rendering.ellipses.pairs_of`."""
    return cast(TileList, listed(ellipses, grid, top, bottom))
