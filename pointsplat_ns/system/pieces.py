"""Computes many rows in pieces, so that intermediate results stay small."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch
from torch import Tensor

CHUNK = 1 << 16
"""Number of rows of a piece on a CPU."""


def pieces(count: int, device: torch.device, rows: int = CHUNK) -> Iterator[slice]:
    """All of ``count`` rows in pieces of so many; of eight times as many on a GPU, which small ones leave idle."""
    size = rows if device.type == "cpu" else 8 * rows
    return (slice(first, min(first + size, count)) for first in range(0, count, size))


def in_pieces(
    function: Callable[[Tensor], Tensor], members: Tensor, *shape: int, dtype: torch.dtype = torch.float64
) -> Tensor:
    """Results (n, *shape) of a function for all members (n,), computed for a piece (m,) of them at a time.

    They are written into one tensor on the members' device: small results kept apart would hold on to the memory of the
    large pieces."""
    result = torch.empty(len(members), *shape, dtype=dtype, device=members.device)
    for these in pieces(len(members), members.device):
        result[these] = function(members[these]).to(dtype)
    return result
