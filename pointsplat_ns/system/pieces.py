"""Computes many rows in pieces on several threads, to keep intermediate results small."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.system.threads import in_threads

CHUNK = 1 << 16
"""Number of rows per piece on a CPU."""


def pieces(count: int, device: torch.device, rows: int = CHUNK) -> list[slice]:
    """Slices of ``rows`` rows that cover ``count`` rows; eight times as large on a GPU, which small
    pieces leave idle."""
    size = rows if device.type == "cpu" else 8 * rows
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def in_pieces(
    function: Callable[[Tensor], Tensor],
    members: Tensor,
    *shape: int,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Results (n, *shape) of a function of members (n,), computed for pieces (m,) at a time.

    Results are written into one tensor on the members' device, because many small results would
    fragment the memory of the large pieces.
    """
    result = torch.empty(len(members), *shape, dtype=dtype, device=members.device)

    def fill(these: slice) -> None:
        result[these] = function(members[these]).to(dtype)

    in_threads(fill, pieces(len(members), members.device), members.device)
    return result
