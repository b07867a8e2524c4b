"""Applies a function to patches of points, a few patches at a time; see :mod:`~pointsplat_ns.refiner.rows` for why.

A patch is K consecutive points along a curve. A last patch of fewer points is filled up with the points before it,
which keep the result of their own patch. With at most K points in all there is one patch. With K = 1 each patch is a
single point.

Shapes: N points, C channels, P patches of K points.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.refiner.rows import add_by_rows, add_rows, by_rows, rows_at_a_time
from pointsplat_ns.refiner.sparse_ops import permute

Order = tuple[Tensor, Tensor]
"""The order of points along a curve and its inverse, (N,) int64 each."""


def by_patches(
    function: Callable[[Tensor], Tensor],  # [P * K, C] -> [P * K, C], each patch by itself
    x: Tensor,  # [N, C]
    width: int,  # columns of the widest tensor within the function
    patch: int = 1,
    order: Order | None = None,  # None: the order in memory
) -> Tensor:
    """``function(x)``. # [N, C]"""
    patch, full = _whole_patches(len(x), patch)
    if order is not None:
        x = permute(x, *order)
    whole = x if full == len(x) else x[:full]  # a slice of everything would cost a copy in the backward pass
    out = by_rows(function, whole, rows_at_a_time(width, patch))
    if full < len(x):
        out = torch.cat([out, function(x[len(x) - patch :])[full - len(x) :]])
    return out if order is None else permute(out, order[1], order[0])


def add_by_patches(
    function: Callable[[Tensor], Tensor],  # [P * K, C] -> [P * K, C], each patch by itself
    x: Tensor,  # [N, C]
    width: int,  # columns of the widest tensor within the function
    patch: int = 1,
    order: Order | None = None,  # None: the order in memory
) -> Tensor:
    """``x + function(x)`` in place of ``x``, without gradients and without a second tensor of that size. # [N, C]"""
    patch, full = _whole_patches(len(x), patch)
    along = None if order is None else order[0]
    last = None
    if full < len(x):  # read before it changes: the last patch includes points of the one before
        filled = x[len(x) - patch :] if along is None else x.index_select(0, along[len(x) - patch :])
        last = function(filled)[full - len(x) :]
    add_by_rows(function, x, rows_at_a_time(width, patch), along, full)
    if last is not None:
        add_rows(x, last, along, full)
    return x


def _whole_patches(n: int, patch: int) -> tuple[int, int]:
    """Number of points in a patch, and in all whole patches together, of ``n`` points."""
    patch = max(1, min(patch, n))
    return patch, n // patch * patch
