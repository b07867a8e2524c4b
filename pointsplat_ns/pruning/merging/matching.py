"""Which pairs go: disjoint pairs of neighbours, the cheapest first."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.pruning.merging.settings import DEFAULTS
from pointsplat_ns.system.pieces import CHUNK
from pointsplat_ns.system.threads import in_threads

_SCATTER = 2654435761
"""Odd, so that multiplying by it modulo 2^32 permutes the numbers of pairs (Knuth's multiplicative hashing)."""


def cheapest_pairs(
    near: Tensor, costs: Tensor, most: int, passes: int = DEFAULTS.matching_passes
) -> tuple[Tensor, Tensor]:
    """Disjoint pairs of neighbours.

    Each pass takes the pairs that are the cheapest for both of their members, among the Gaussians still free. Ties are
    broken by hashed numbers: broken by the numbers themselves, a row of equal Gaussians would yield one pair a pass.

    Args:
        near: (n, k) int32, indices of the neighbours of each Gaussian; its own index means none.
        costs: (n, k) float32, at least 0, of merging each with each neighbour. Where two are neighbours of each other,
            the mean of their two costs counts.
        most: largest number of pairs.
        passes: number of passes.

    Returns:
        First and second members, (E,) int64 each; at least one pair if there is any neighbour and ``most`` is not 0.
    """
    n = len(near)
    costs = _symmetric(near, costs)
    free = torch.ones(n, dtype=torch.bool)
    rows = torch.arange(n)
    firsts, seconds, prices = [], [], []
    for _ in range(passes):
        best = torch.full((n,), torch.iinfo(torch.int64).max)
        for these in rows.split(CHUNK):
            keys = _keys(these, costs)
            best[these] = torch.minimum(best[these], keys.amin(1))
            best.scatter_reduce_(0, near[these].flatten().long(), keys.flatten(), "amin")
        found = []
        for these in rows.split(CHUNK):
            keys, others = _keys(these, costs), near[these].long()
            mutual = (keys == best[these][:, None]) & (keys == best[others]) & costs[these].isfinite()
            row, slot = mutual.nonzero(as_tuple=True)
            found.append((these[row], others[row, slot], costs[these[row], slot]))
        first, second, price = (torch.cat(parts) for parts in zip(*found, strict=True))
        if len(first) == 0:
            break
        firsts.append(first)
        seconds.append(second)
        prices.append(price)
        free[first] = False
        free[second] = False
        rows = rows[free[rows]]
        for these in rows.split(CHUNK):
            costs[these] = costs[these].where(free[near[these].long()], math.inf)
        rows = rows[costs[rows].amin(1) < math.inf]
        if len(rows) == 0:
            break
    if not firsts:
        return torch.empty(0, dtype=torch.int64), torch.empty(0, dtype=torch.int64)
    first, second, price = torch.cat(firsts), torch.cat(seconds), torch.cat(prices)
    chosen = price.sort(stable=True).indices[:most]
    return first[chosen], second[chosen]


def _symmetric(near: Tensor, costs: Tensor) -> Tensor:
    """Costs (n, k) with each pair once: the mean of its two costs in the row of the smaller index, infinity in the row
    of the other. A Gaussian with itself costs infinity."""
    result = torch.empty_like(costs)

    def fill(me: Tensor) -> None:
        others = near[me].long()
        back = near[others] == me[:, None, None]
        both, slot = back.any(2), back.to(torch.uint8).argmax(2)
        mean = (costs[me] + costs[others, slot]) / 2
        mine = costs[me].where(~both, mean.where(others > me[:, None], math.inf))
        result[me] = mine.where(others != me[:, None], math.inf).nan_to_num(nan=math.inf, posinf=math.inf)

    in_threads(fill, torch.arange(len(near)).split(CHUNK))
    return result


def _keys(rows: Tensor, costs: Tensor) -> Tensor:
    """Numbers (m, k) int64 that are ordered as the costs of rows (m,), all different: the bits of a float32 that is not
    negative are ordered as the float is."""
    k = costs.shape[1]
    numbers = rows[:, None] * k + torch.arange(k)
    return (costs[rows].view(torch.int32).long() << 32) | ((numbers * _SCATTER) & 0xFFFFFFFF)
