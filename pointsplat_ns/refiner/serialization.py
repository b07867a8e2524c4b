"""Space-filling curves in three dimensions: from integer coordinates to positions along a curve.

Points that are close along a curve are close in space, so a patch of consecutive points is a neighbourhood. Both curves
are hierarchical: the code of a coarser cell is the code of any of its points without the last three bits per halving.
So one sort serves all grids of the network.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache

import torch
from torch import Tensor

from pointsplat_ns.geometry.transforms import interleave, spread_bits
from pointsplat_ns.refiner.sparse_ops import by_rows, permute, rows_at_a_time
from pointsplat_ns.system.tensors import INDICES


def curve_codes(coords: Tensor, bits: int, curves: Sequence[str]) -> list[Tensor]:
    """Codes (N,) in ``[0, 8**bits)`` along each named curve, int64.

    Args:
        coords: integer coordinates, each at least 0 and below ``2**bits``.  # [N, 3] int64
        bits: bits per axis, at most 20.
        curves: ``z`` for the z-order (Morton) curve, which interleaves the bits of the three axes; ``hilbert`` for the
            Hilbert curve, whose consecutive cells always share a face; or either with ``-trans``: the same curve with x
            and y exchanged. Others are a ValueError.
    """
    if not 1 <= bits <= 20:
        raise ValueError(f"{bits} bits per axis; expected 1 to 20, so that a code fits an int64")
    x, y, z = (spread_bits(coords[:, axis]) for axis in range(3))
    codes = []
    for curve in curves:
        base, _, variant = curve.partition("-")
        if base not in ("z", "hilbert") or variant not in ("", "trans"):
            raise ValueError(f"no curve {curve!r}; expected z, z-trans, hilbert or hilbert-trans")
        code = interleave(y, x, z) if variant else interleave(x, y, z)
        codes.append(code if base == "z" else _hilbert_from_z(code, bits))
    return codes


def _hilbert_from_z(code: Tensor, bits: int) -> Tensor:
    """Hilbert code of each z-order code: octants from the coarsest on, a few levels at a time. # [N] int64"""
    at_once = 4  # levels per look-up: the table has 48 x 8^4 entries, which fit into the cache
    out, state = torch.zeros_like(code), None
    while bits:
        levels = bits % at_once or at_once
        bits -= levels
        table = _hilbert_table(levels, code.device)
        place = code >> 3 * bits
        place &= 8**levels - 1
        if state is not None:
            place += state
        entry = table.index_select(0, place)
        digits = entry & (8**levels - 1)
        out <<= 3 * levels
        out |= digits
        state = (entry >> 3 * levels) << 3 * at_once  # all later look-ups are of so many
    return out


@lru_cache
def _hilbert_table(levels: int, device: torch.device) -> Tensor:
    """Digits and next state by state and octants, packed: ``next << 3 * levels | digits``. # [48 * 8**levels] int32"""
    octants, following = _hilbert_states()
    digits, state = octants, following
    for _ in range(levels - 1):  # one level more in front
        digits = ((octants * digits.shape[1])[:, :, None] + digits[following]).flatten(1)
        state = state[following].flatten(1)
    return ((state << 3 * levels) | digits).flatten().to(device, torch.int32)


@lru_cache
def _hilbert_states() -> tuple[Tensor, Tensor]:
    """The Hilbert curve as an automaton: digit and next state by state and octant, from state 0 on. # [48, 8] int64

    At each bit, a mirror or an exchange of axes applies to all lower bits, according to the octant,
    and the octant is Gray-coded. A state is the composition of these so far: the source of each axis, whether it
    is mirrored, and the parity of the Gray code. Source: J. Skilling, "Programming the Hilbert curve", AIP
    Conference Proceedings 707 (2004).
    """
    State = tuple[tuple[int, ...], tuple[int, ...], int]
    states: dict[State, int] = {((0, 1, 2), (0, 0, 0), 0): 0}
    digits, following = [], []
    for axes, mirrors, parity in (queue := list(states)):
        for octant in range(8):
            source, mirror = list(axes), list(mirrors)
            bits = [(octant >> (2 - source[i]) & 1) ^ mirror[i] for i in range(3)]
            for i in range(3):
                if bits[i]:
                    mirror[0] ^= 1
                else:
                    source[0], source[i] = source[i], source[0]
                    mirror[0], mirror[i] = mirror[i], mirror[0]
            gray = bits[0], bits[0] ^ bits[1], bits[0] ^ bits[1] ^ bits[2]
            reached = tuple(source), tuple(mirror), parity ^ gray[2]
            if reached not in states:
                states[reached] = len(states)
                queue.append(reached)
            digits.append(sum((bit ^ parity) << (2 - i) for i, bit in enumerate(gray)))
            following.append(states[reached])
    return torch.tensor(digits, **INDICES).view(-1, 8), torch.tensor(following, **INDICES).view(-1, 8)


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
