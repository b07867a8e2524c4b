"""Applies row-wise functions to a few thousand rows at a time, so that intermediate results fit into a CPU's cache.

Allocating a tensor of tens of megabytes takes longer than the matrix product that fills it, because the system provides
each page anew. The memory of tensors of a few megabytes is reused.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

MAX_ELEMENTS = 2**20
"""Largest number of elements of the widest tensor in one call on a CPU: 4 MB in float32."""


def rows_at_a_time(width: int, multiple: int = 1) -> int:
    """Number of rows of ``width`` elements that a CPU computes in one call: a positive multiple of ``multiple``."""
    return max(1, MAX_ELEMENTS // (width * multiple)) * multiple


def by_rows(
    function: Callable[[Tensor], Tensor],  # [R, Cin] -> [R, Cout], row by row
    x: Tensor,  # [N, Cin]
    rows: int,
) -> Tensor:
    """``function(x)``, on a CPU computed from ``rows`` rows at a time. # [N, Cout]"""
    if x.device.type != "cpu" or len(x) <= rows:
        return function(x)
    if torch.is_grad_enabled():
        return torch.cat([function(part) for part in x.split(rows)])
    first = function(x[:rows])
    out = first.new_empty(len(x), *first.shape[1:])
    out[:rows] = first
    for start in range(rows, len(x), rows):
        out[start : start + rows] = function(x[start : start + rows])
    return out
