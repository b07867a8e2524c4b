"""Space-filling curves in three dimensions: from integer coordinates to positions along a curve.

Points that are close along a curve are close in space, so that a patch of consecutive points is a
neighbourhood. Both curves are hierarchical: the code of a coarser cell is the code of any of its
points without the last three bits per halving. That makes one sort serve all grids of the network.
"""

from __future__ import annotations

import torch
from torch import Tensor


def z_order(coords: Tensor, bits: int) -> Tensor:
    """Position along the z-order (Morton) curve: the bits of the three axes, interleaved.

    Args:
        coords: integer coordinates, each at least 0 and below ``2**bits``.  # [N, 3] int64
        bits: bits per axis, at most 20.

    Returns:
        codes in ``[0, 8**bits)``.  # [N] int64
    """
    return _interleave([_spread(coords[:, axis]) for axis in range(3)])


def hilbert(coords: Tensor, bits: int) -> Tensor:
    """Position along the Hilbert curve, whose consecutive cells always share a face.

    Walks from the highest bit to the lowest, undoing the rotation that the octant of each bit
    stands for, then Gray-codes the result. Source: J. Skilling, "Programming the Hilbert curve",
    AIP Conference Proceedings 707 (2004).

    Args:
        coords: integer coordinates, each at least 0 and below ``2**bits``.  # [N, 3] int64
        bits: bits per axis, at most 20.

    Returns:
        codes in ``[0, 8**bits)``.  # [N] int64
    """
    # Half as wide, the integers take half as long; shifted to the top and back, a bit fills the word as a mask.
    axes = [coords[:, axis].to(torch.int32, copy=True) for axis in range(3)]
    for bit in range(bits - 1, 0, -1):
        low = (1 << bit) - 1
        for axis in range(3):
            # Bit set: mirror the first axis below this bit. Bit clear: swap the first axis with this one there.
            mirrored = ((axes[axis] << (31 - bit)) >> 31) & low
            if axis:
                swapped = (axes[0] ^ axes[axis]) & (mirrored ^ low)
                axes[axis] ^= swapped
                axes[0] ^= swapped
            axes[0] ^= mirrored
    axes[1] ^= axes[0]
    axes[2] ^= axes[1]
    parity = axes[2] >> 1  # of the bits above each bit: doubled in reach five times
    for reach in (1, 2, 4, 8, 16):
        parity ^= parity >> reach
    return _interleave([_spread((axis ^ parity).long()) for axis in axes])


def curve_codes(coords: Tensor, bits: int, curve: str) -> Tensor:
    """Codes along a named curve.

    Args:
        coords: integer coordinates, each at least 0 and below ``2**bits``.  # [N, 3] int64
        bits: bits per axis, at most 20.
        curve: ``z``, ``hilbert``, or either with ``-trans``: the same curve with x and y exchanged.

    Returns:
        codes in ``[0, 8**bits)``.  # [N] int64

    Raises:
        ValueError: if there is no such curve.
    """
    base, _, variant = curve.partition("-")
    functions = {"z": z_order, "hilbert": hilbert}
    if base not in functions or variant not in ("", "trans"):
        raise ValueError(f"no curve {curve!r}; expected z, z-trans, hilbert or hilbert-trans")
    if not 1 <= bits <= 20:
        raise ValueError(f"{bits} bits per axis; expected 1 to 20, so that a code fits an int64")
    return functions[base](coords[:, [1, 0, 2]] if variant else coords, bits)


def _spread(x: Tensor) -> Tensor:
    """Moves bit k to bit 3k, for k below 21, by halving the distance still to go five times."""
    x = x & 0x1FFFFF
    x = (x | (x << 32)) & 0x1F00000000FFFF
    x = (x | (x << 16)) & 0x1F0000FF0000FF
    x = (x | (x << 8)) & 0x100F00F00F00F00F
    x = (x | (x << 4)) & 0x10C30C30C30C30C3
    return (x | (x << 2)) & 0x1249249249249249


def _interleave(axes: list[Tensor]) -> Tensor:
    return (axes[0] << 2) | (axes[1] << 1) | axes[2]
