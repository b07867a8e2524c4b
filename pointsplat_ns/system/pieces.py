"""Computes many rows in pieces, so that intermediate results stay small."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import INDICES

CHUNK = 1 << 16
"""Number of rows of a piece."""


def in_pieces(
    function: Callable[[Tensor], Tensor], members: Tensor, *shape: int, dtype: torch.dtype = torch.float64
) -> Tensor:
    """Results (n, *shape) of a function for all members (n,), computed for a piece (m,) of them at a time.

    They are written into one tensor: small results kept apart would hold on to the memory of the large pieces."""
    result = torch.empty(len(members), *shape, dtype=dtype, device="cpu")
    for these in torch.arange(len(members), **INDICES).split(CHUNK):
        result[these] = function(members[these]).to(dtype)
    return result
