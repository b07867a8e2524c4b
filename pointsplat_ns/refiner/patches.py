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

from pointsplat_ns.refiner.rows import by_rows, rows_at_a_time
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
    patch = max(1, min(patch, len(x)))
    full = len(x) // patch * patch  # points in whole patches
    if order is not None:
        x = permute(x, *order)
    whole = x if full == len(x) else x[:full]  # a slice of everything would cost a copy in the backward pass
    out = by_rows(function, whole, rows_at_a_time(width, patch))
    if full < len(x):
        out = torch.cat([out, function(x[len(x) - patch :])[full - len(x) :]])
    return out if order is None else permute(out, order[1], order[0])
