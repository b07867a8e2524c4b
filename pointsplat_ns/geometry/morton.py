"""Space-filling curves: Morton codes of positions."""

from __future__ import annotations

import torch
from torch import Tensor


def spread_bits(x: Tensor) -> Tensor:
    """Move bit k of every integer to bit 3k, for k below 21, in five steps of half the distance each.

    Args:
        x: int64 of any shape; bits from 21 on are dropped.
    """
    x = x & 0x1FFFFF
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x |= x << shift
        x &= mask
    return x


def interleave(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """The Morton code of three coordinates whose bits are spread; x has the highest bit."""
    return (x << 2).bitwise_or_(y << 1).bitwise_or_(z)


def unit_cells(means: Tensor) -> Tensor:
    """Positions (N, 3), float32, scaled so that most lie in a cube of side 1/2 around 1/2; those far outside are
    clamped to [0, 1]. So the few distant Gaussians of most scenes do not coarsen the grid of the others."""
    some = means[:: max(1, len(means) // 2**14)].double()
    n = len(some)
    ranked = some.sort(dim=0).values
    low, high = ranked[(n - 1) // 100], ranked[n - 1 - (n - 1) // 100]
    side = 2 * (high - low).amax()
    cells = (means.double() - 0.5 * (low + high)).div_(side.clamp_min(torch.finfo(torch.float64).tiny))
    return cells.float().clamp_(-0.5, 0.5).add_(0.5)


def curve_keys(cells: Tensor, offset: float = 0.0) -> Tensor:
    """Morton codes (N,) int64 of points (N, 3) in the unit cube, shifted by ``offset`` along each axis."""
    grid = (cells.T + offset).clamp_(0, 1).mul_(2**20 - 1).long()  # 60 of the 63 bits in a key
    return interleave(*(spread_bits(axis) for axis in grid))
