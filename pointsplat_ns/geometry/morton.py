"""Bits of grid coordinates, as space-filling curves arrange them."""

from __future__ import annotations

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
