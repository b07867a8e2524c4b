"""Computes many rows in pieces on several threads, so that intermediate results stay small."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.system.threads import in_threads

CHUNK = 1 << 16
"""Number of rows of a piece on a CPU."""


def pieces(count: int, device: torch.device, rows: int = CHUNK) -> list[slice]:
    """All of ``count`` rows in pieces of so many; of eight times as many on a GPU, which small ones
    leave idle."""
    size = rows if device.type == "cpu" else 8 * rows
    return [slice(first, min(first + size, count)) for first in range(0, count, size)]


def in_pieces(
    function: Callable[[Tensor], Tensor],
    members: Tensor,
    *shape: int,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    """Results (n, *shape) of a function for all members (n,), computed for a piece (m,) of them at
    a time.

    They are written into one tensor on the members' device: small results kept apart would hold on
    to the memory of the large pieces."""
    result = torch.empty(len(members), *shape, dtype=dtype, device=members.device)

    def fill(these: slice) -> None:
        result[these] = function(members[these]).to(dtype)

    in_threads(fill, pieces(len(members), members.device), members.device)
    return result
