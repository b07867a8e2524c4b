"""Blending with compiled kernels (``blending.cpp``); :mod:`~pointsplat_ns.rendering.blocks` is the
same in torch."""

from __future__ import annotations

import ctypes
import math
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rendering.alpha import CLAMPED
from pointsplat_ns.rendering.constants import ALPHA_MAX, TRANSMITTANCE_MIN
from pointsplat_ns.rendering.ellipses import Grid, TileList
from pointsplat_ns.rendering.quadratics import MOMENTS, PIXELS
from pointsplat_ns.system.kernels import (
    FLOAT_POINTER,
    INT64_POINTER,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.tensors import FLOATS, INDICES


class TaskStruct(Struct):
    """``Task`` of ``blending.cpp``, which documents its members."""

    members = {
        "table": FLOAT_POINTER,
        "gaussians": INT64_POINTER,
        "offsets": INT64_POINTER,
        "chunks": INT64_POINTER,
        "tiles": ctypes.c_int64,
        "columns": ctypes.c_int64,
        "top": ctypes.c_int64,
        "width": ctypes.c_int64,
        "height": ctypes.c_int64,
        "channels": ctypes.c_int64,
        "log2_alpha_min": ctypes.c_float,
        "alpha_max": ctypes.c_float,
        "clamped_from": ctypes.c_float,
        "transmittance_min": ctypes.c_float,
        "image": FLOAT_POINTER,
        "final_": FLOAT_POINTER,
        "before": FLOAT_POINTER,
        "blended": INT64_POINTER,
        "grad_image": FLOAT_POINTER,
        "grad_final": FLOAT_POINTER,
        "sums": FLOAT_POINTER,
        "absolute": ctypes.c_int64,
    }
    _fields_ = c_fields(members)


chunk_kernel = Function("pointsplat_chunk", result=ctypes.c_int32)
blend_kernel = Function("pointsplat_blend", TaskStruct, INT64_POINTER)
differentiate_kernel = Function("pointsplat_differentiate", TaskStruct, INT64_POINTER)
weigh_kernel = Function("pointsplat_weigh", TaskStruct, INT64_POINTER)
gather_kernel = Function(
    "pointsplat_gather",
    FLOAT_POINTER,
    INT64_POINTER,
    INT64_POINTER,
    INT64_POINTER,
    ctypes.c_int64,
    ctypes.c_int64,
    FLOAT_POINTER,
    INT64_POINTER,
)
tabulate_kernel = Function(
    "pointsplat_tabulate",
    FLOAT_POINTER,
    FLOAT_POINTER,
    FLOAT_POINTER,
    FLOAT_POINTER,
    FLOAT_POINTER,
    ctypes.c_int64,
    ctypes.c_int64,
    FLOAT_POINTER,
    INT64_POINTER,
)
chain_kernel = Function(
    "pointsplat_chain",
    FLOAT_POINTER,
    ctypes.c_int64,
    FLOAT_POINTER,
    FLOAT_POINTER,
    FLOAT_POINTER,
    ctypes.c_int64,
    FLOAT_POINTER,
    FLOAT_POINTER,
    FLOAT_POINTER,
    FLOAT_POINTER,
    INT64_POINTER,
)


class KernelTape(NamedTuple):
    """Results of the forward pass for the backward pass."""

    before: Tensor  # [chunks, 64] transmittance in front of each chunk of a tile's list
    blended: Tensor  # [tiles] int64, Gaussians processed before all pixels were finished
    chunks: Tensor  # [tiles + 1] int64, start of each tile's chunks


def inputs_of(
    means2d: Tensor,
    cov2d: Tensor,
    det: Tensor,
    opacities: Tensor,
    colors: Tensor,
    _alpha_min: float,
) -> Tensor:
    """Table of projected Gaussians for the kernels, (M, 6 + D): geometry, then colours (M, D)."""
    count, channels = colors.shape
    tensors = [tensor.contiguous() for tensor in (means2d, cov2d, det, opacities, colors)]
    table = colors.new_empty(count, 6 + channels)
    on_threads(count >= SEVERAL, tabulate_kernel, *tensors, count, channels, table)
    return table


def chain(summed: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor) -> list[Tensor]:
    """As :func:`~pointsplat_ns.rendering.quadratics.chain`."""
    count = len(summed)
    cov2d = cov2d.contiguous()
    det = det.contiguous()
    opacities = opacities.contiguous()
    grads = [
        det.new_empty(count, 2),
        torch.empty_like(cov2d),
        torch.empty_like(det),
        torch.empty_like(opacities),
    ]
    on_threads(
        count >= SEVERAL,
        chain_kernel,
        summed.data_ptr(),
        summed.stride(0),
        cov2d,
        det,
        opacities,
        count,
        *grads,
    )
    return grads


def task_of(
    table: Tensor, grid: Grid, gaussians: Tensor, offsets: Tensor, chunks: Tensor, top: int = 0
) -> Struct:
    """The task of drawing rows of tiles, without its output.

    Args:
        table: of :func:`inputs_of`.
        grid: of the image.
        gaussians: (P,) int64, rows of the table, by tile and front to back.
        offsets: (tiles + 1,) int64, start of each tile's Gaussians.
        chunks: (tiles + 1,) int64, start of each tile's chunks; ignored without a tape.
        top: first row of tiles.
    """
    return TaskStruct(
        table=table,
        gaussians=gaussians,
        offsets=offsets,
        chunks=chunks,
        tiles=offsets.numel() - 1,
        columns=grid.columns,
        top=top,
        width=grid.width,
        height=grid.height,
        channels=table.shape[1] - 6,
        log2_alpha_min=math.log2(grid.alpha_min),
        alpha_max=ALPHA_MAX,
        clamped_from=CLAMPED,
        transmittance_min=TRANSMITTANCE_MIN,
    )


def blend_region(
    grid: Grid, tiles: TileList, table: Tensor, image: Tensor, final: Tensor, keep_tape: bool
) -> KernelTape | None:
    """Blend the tiles of a region into ``image`` (tiles, D, 64) and ``final`` (tiles, 64); returns
    the tape if requested."""
    size = chunk_kernel()
    chunks = torch.zeros_like(tiles.offsets)
    torch.cumsum(
        (tiles.offsets.diff() + (size - 1)).div_(size, rounding_mode="floor"), 0, out=chunks[1:]
    )
    before = image.new_empty(int(chunks[-1]) if keep_tape else 0, PIXELS)
    blended = torch.empty_like(tiles.offsets[1:])
    task = task_of(table, grid, tiles.gaussians, tiles.offsets, chunks, tiles.top)
    task.fill(
        image=image,
        final_=final,
        blended=blended,
        before=before if keep_tape and len(before) else None,
    )
    on_threads(tiles.gaussians.numel() >= SEVERAL, blend_kernel, task)
    return KernelTape(before, blended, chunks) if keep_tape else None


def weigh(task: Struct, pairs: Tensor, count: int) -> Tensor:
    """Blending weight of each of ``count`` Gaussians, summed over pixels, (count,). The task's
    table has no colours; ``pairs`` (P,) are rows of the table."""
    sums = torch.empty(pairs.numel(), **FLOATS)
    task.fill(sums=sums)
    on_threads(len(sums) >= SEVERAL, weigh_kernel, task)
    # one thread, in tile order
    return sums.new_zeros(count).index_add_(0, pairs, sums)


def differentiate_region(
    grid: Grid,
    tiles: TileList,
    table: Tensor,
    tape: KernelTape,
    final: Tensor,  # [tiles, 64]
    grad_image: Tensor,  # [tiles, D, 64]
    grad_final: Tensor,  # [tiles, 64]
    absgrad: bool,
) -> Tensor:
    """Moments, colour gradients and absolute gradients of the Gaussians of a table from one region,
    (rows of the table, MOMENTS + D [+ 2]); undefined for Gaussians that are not in the tiles'
    order."""
    pairs = tiles.gaussians.numel()
    count = tiles.order.numel()
    columns = MOMENTS + table.shape[1] - 6 + (2 if absgrad else 0)
    sums = grad_image.new_empty(pairs, columns)
    out = grad_image.new_empty(len(table), columns)
    task = task_of(table, grid, tiles.gaussians, tiles.offsets, tape.chunks, tiles.top)
    task.fill(
        final_=final,
        before=tape.before,
        blended=tape.blended,
        grad_image=grad_image.contiguous(),
        grad_final=grad_final.contiguous(),
        sums=sums,
        absolute=int(absgrad),
    )
    on_threads(pairs >= SEVERAL, differentiate_kernel, task)

    # the sum of each Gaussian's pairs, in tile order
    by_gaussian = torch.empty_like(tiles.places)
    by_gaussian.index_copy_(0, tiles.places, torch.arange(pairs, **INDICES))
    starts = torch.zeros(count + 1, **INDICES)
    torch.cumsum(tiles.counts, 0, out=starts[1:])
    on_threads(
        pairs >= SEVERAL,
        gather_kernel,
        sums,
        by_gaussian,
        starts,
        tiles.order,
        count,
        columns,
        out,
    )
    return out
