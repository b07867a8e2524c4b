"""The sparse operations of the network: permutation, maximum and mean per cluster, submanifold
convolution, pieces.

The first and the fourth have their own backward. Autograd's backward of a gather accumulates row by
row; for a permutation or distinct targets a gather is enough. No function allocates more than a few
times [N, C].
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

Order = tuple[Tensor, Tensor]
"""The order of points along a curve and its inverse, (N,) int64 each."""

KernelMap = list[tuple[Tensor, Tensor]]
"""Pairs of neighbouring cells, from ``structure.neighbour_pairs``: for each offset in one half of
the kernel, the cells (i, j) with j at i + offset, (P,) int64 each."""


class _Permute(Function):
    @staticmethod
    def forward(ctx, x: Tensor, order: Tensor, inverse: Tensor) -> Tensor:
        ctx.inverse = inverse
        return x.index_select(0, order)

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor):
        return grad.index_select(0, ctx.inverse), None, None


def permute(
    x: Tensor,  # [N, C]
    order: Tensor,  # [N] int64, a permutation
    inverse: Tensor,  # [N] int64, its inverse
) -> Tensor:
    """``x[order]``. # [N, C]"""
    return _Permute.apply(x, order, inverse)


def segment_max(
    x: Tensor,  # [N, C]
    cluster: Tensor,  # [N] int64 in [0, size), each value at least once
    size: int,
) -> Tensor:
    """Maximum over the rows of each cluster; the gradient of a tie is divided evenly. # [size,
    C]"""
    index = cluster[:, None].expand_as(x)
    return x.new_zeros(size, x.shape[1]).scatter_reduce(0, index, x, "amax", include_self=False)


class _SubmanifoldConv(Function):
    @staticmethod
    def forward(ctx, x: Tensor, weight: Tensor, kernel_map: KernelMap) -> Tensor:
        ctx.save_for_backward(x, weight)
        ctx.kernel_map = kernel_map
        out = x @ weight[13]
        for k, i, j in _parts(kernel_map, x):
            out.index_add_(0, i, x.index_select(0, j) @ weight[14 + k])
            out.index_add_(0, j, x.index_select(0, i) @ weight[12 - k])
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx, grad: Tensor):
        x, weight = ctx.saved_tensors
        need_x, need_weight = ctx.needs_input_grad[:2]
        grad_x = grad @ weight[13].T if need_x else None
        grad_weight = torch.zeros_like(weight) if need_weight else None
        if grad_weight is not None:
            torch.mm(x.T, grad, out=grad_weight[13])
        for k, i, j in _parts(ctx.kernel_map, x):
            grad_i = grad.index_select(0, i)
            grad_j = grad.index_select(0, j)
            if grad_weight is not None:
                grad_weight[14 + k].addmm_(x.index_select(0, j).T, grad_i)
                grad_weight[12 - k].addmm_(x.index_select(0, i).T, grad_j)
            if grad_x is not None:
                grad_x.index_add_(0, j, grad_i @ weight[14 + k].T)
                grad_x.index_add_(0, i, grad_j @ weight[12 - k].T)
        return grad_x, grad_weight, None


def _parts(kernel_map: KernelMap, x: Tensor) -> Iterator[tuple[int, Tensor, Tensor]]:
    """Offset and indices of all pairs, on a CPU in parts that fit into its cache."""
    for k, (i, j) in enumerate(kernel_map):
        rows = rows_at_a_time(x.shape[1]) if x.device.type == "cpu" else max(1, len(i))
        for part_i, part_j in zip(i.split(rows), j.split(rows), strict=True):
            if len(part_i):
                yield k, part_i, part_j


def submanifold_conv(
    x: Tensor,  # [M, Cin] one row per occupied cell
    # [27, Cin, Cout] taps in the order of (dx, dy, dz) from (-1, -1, -1), dz fastest
    weight: Tensor,
    kernel_map: KernelMap,
) -> Tensor:
    """3x3x3 convolution on the occupied cells alone: ``out[p] = sum_d x[p + d] @ weight[d]`` over
    existing ``p + d``. Only those are multiplied; each tap holds one [P, C] gather at a time. # [M,
    Cout]"""
    return _SubmanifoldConv.apply(x, weight, kernel_map)


def segment_mean(
    x: Tensor,  # [N, C]
    cluster: Tensor,  # [N] int64 in [0, size), each value at least once
    size: int,
) -> Tensor:
    """Mean over the rows of each cluster. # [size, C]"""
    count = torch.bincount(cluster, minlength=size).to(x.dtype)
    return x.new_zeros(size, x.shape[1]).index_add_(0, cluster, x).div_(count[:, None])


MAX_ELEMENTS = 2**20
"""Largest number of elements of the widest tensor in one call on a CPU: 4 MB in float32."""


def rows_at_a_time(width: int, multiple: int = 1) -> int:
    """Number of rows of ``width`` elements that a CPU computes in one call: a positive multiple of
    ``multiple``."""
    return max(1, MAX_ELEMENTS // (width * multiple)) * multiple


def by_rows(
    function: Callable[[Tensor], Tensor],  # [R, Cin] -> [R, Cout], row by row
    x: Tensor,  # [N, Cin]
    rows: int,
) -> Tensor:
    """``function(x)``, on a CPU computed from ``rows`` rows at a time. # [N, Cout]"""
    if x.device.type != "cpu" or len(x) <= rows:
        return function(x)
    return torch.cat([function(part) for part in x.split(rows)])


def by_patches(
    function: Callable[[Tensor], Tensor],  # [P * K, C] -> [P * K, C], each patch by itself
    x: Tensor,  # [N, C]
    width: int,  # columns of the widest tensor within the function
    patch: int = 1,
    order: Order | None = None,  # None: the order in memory
) -> Tensor:
    """``function(x)``. # [N, C]"""
    patch = max(1, min(patch, len(x)))
    full = len(x) // patch * patch  # points in whole patches
    if order is not None:
        x = permute(x, *order)
    whole = (
        x if full == len(x) else x[:full]
    )  # a slice of everything would cost a copy in the backward pass
    out = by_rows(function, whole, rows_at_a_time(width, patch))
    if full < len(x):
        out = torch.cat([out, function(x[len(x) - patch :])[full - len(x) :]])
    return out if order is None else permute(out, order[1], order[0])
