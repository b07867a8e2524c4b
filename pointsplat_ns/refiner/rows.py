"""Row by row, a few thousand rows at a time, so that what lies between two layers never leaves a CPU's cache.

A fresh tensor of tens of megabytes costs more than the matrix product that fills it: the system hands out every
page of it anew. Tensors of a few megabytes are handed from one use to the next.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

CELLS = 2**20
"""Numbers that the widest tensor of one go may hold on a CPU: 4 MB in float32."""


def rows_at_a_time(width: int, multiple: int = 1) -> int:
    """Rows of ``width`` numbers that a CPU takes in one go: a multiple of ``multiple``, and at least that."""
    return max(1, CELLS // (width * multiple)) * multiple


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
