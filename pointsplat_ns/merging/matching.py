"""Which pairs go: disjoint pairs of neighbours, the cheapest first, found by compiled kernels (``matching.cpp``) or in
torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.merging.settings import MERGING
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, on_threads
from pointsplat_ns.system.tensors import FLAGS, INDICES
from pointsplat_ns.system.threads import most_threads


def cheapest_pairs(
    near: Tensor, costs: Tensor, most: int, passes: int = MERGING.matching_passes, compiled: bool | None = None
) -> tuple[Tensor, Tensor]:
    """Disjoint pairs of neighbours.

    Each pass takes the pairs that are the cheapest for both of their members, among the Gaussians still free. Ties are
    broken by hashed numbers: broken by the numbers themselves, a row of equal Gaussians would yield one pair a pass.

    Args:
        near: (n, k) int32, indices of the neighbours of each Gaussian; its own index means none.
        costs: (n, k) float32, at least 0, of merging each with each neighbour. Where two are neighbours of each other,
            the mean of their two costs counts. They are overwritten.
        most: largest number of pairs.
        passes: number of passes.
        compiled: False leaves it to torch; True warns if there are no kernels.

    Returns:
        First and second members, (E,) int64 each; at least one pair if there is any neighbour and ``most`` is not 0.
    """
    first, second, price = candidate_pairs(near, costs, passes, compiled)
    chosen = price.sort(stable=True).indices[:most]
    return first[chosen], second[chosen]


def candidate_pairs(
    near: Tensor, costs: Tensor, passes: int = MERGING.matching_passes, compiled: bool | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """The pairs of all passes, of which :func:`cheapest_pairs` takes the cheapest: first and second members, (E,) int64
    each, and costs, (E,) float32. Arguments as there."""
    suited = near.dtype == torch.int32 and KERNELS.usable_for(compiled, costs)
    return (_by_kernels if suited else _candidates)(near, costs, passes)


def _candidates(near: Tensor, costs: Tensor, passes: int) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`candidate_pairs`, in torch."""
    n, costs = len(near), _symmetric(near, costs)
    rows, others, found = torch.arange(n, **INDICES), near.long(), []
    for _ in range(passes):
        keys = _keys(rows, costs[rows])
        best = torch.full((n,), torch.iinfo(torch.int64).max, **INDICES)
        best[rows] = keys.amin(1)
        best.scatter_reduce_(0, others[rows].flatten(), keys.flatten(), "amin")
        mutual = (keys == best[rows, None]) & (keys == best[others[rows]]) & costs[rows].isfinite()
        row, slot = mutual.nonzero(as_tuple=True)
        i = rows[row]
        found.append((i, others[i, slot], costs[i, slot]))
        taken = torch.zeros(n, **FLAGS)
        taken[i] = taken[others[i, slot]] = True
        costs = costs.masked_fill(taken[:, None] | taken[others], math.inf)
        rows = rows[costs[rows].amin(1) < math.inf]
        if len(i) == 0 or len(rows) == 0:
            break
    first, second, price = (torch.cat(parts) for parts in zip(*found, strict=True))
    return first, second, price


def _symmetric(near: Tensor, costs: Tensor) -> Tensor:
    """Costs (n, k) with each pair once: the mean of its two costs in the row of the smaller index, infinity in the row
    of the other. A Gaussian with itself costs infinity."""
    others, me = near.long(), torch.arange(len(near), **INDICES)[:, None]
    back = near[others] == me[:, :, None]
    slot = back.to(torch.uint8).argmax(2)
    mean = ((costs + costs[others, slot]) / 2).where(others > me, math.inf)
    once = mean.where(back.any(2), costs).where(others != me, math.inf)
    return once.nan_to_num(nan=math.inf, posinf=math.inf)


def _keys(rows: Tensor, costs: Tensor) -> Tensor:
    """Numbers (m, k) int64 that are ordered as the costs (m, k) of rows (m,), all different: the bits of a float32 that
    is not negative are ordered as the float is."""
    k = costs.shape[1]
    numbers = rows[:, None] * k + torch.arange(k, **INDICES)
    # Multiplying by an odd number modulo 2^32 permutes the numbers of pairs (Knuth's multiplicative hashing).
    return (costs.view(torch.int32).long() << 32) | ((numbers * 2654435761) & 0xFFFFFFFF)


def _by_kernels(near: Tensor, costs: Tensor, passes: int) -> tuple[Tensor, Tensor, Tensor]:
    """As :func:`_candidates`, to the bit; overwrites the costs."""
    n, k = near.shape
    pairs = [torch.empty(n // 2, dtype=dtype, device="cpu") for dtype in (torch.int64, torch.int64, torch.float32)]
    found = torch.zeros(1, **INDICES)
    task = KERNELS.structs["Matching"](
        near=near.contiguous(), costs=costs.contiguous(), count=n, neighbours=k,
        passes=passes, best=torch.empty(n, **INDICES), rows=torch.arange(n, **INDICES), found=found,
        **dict(zip(("firsts", "seconds", "prices"), pairs, strict=True)),
    )  # fmt: skip
    for larger in (1, 0):
        on_threads(n >= SEVERAL, KERNELS.library.pointsplat_symmetric, task, larger, threads=most_threads())
    KERNELS.library.pointsplat_match(task)
    first, second, price = (values[: int(found)] for values in pairs)
    return first, second, price
