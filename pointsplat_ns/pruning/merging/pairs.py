"""Selection of a round's pairs, and their replacement by Gaussians of the same moments.

Each pass over the Gaussians that are still free takes the pairs that are the cheapest for both
members.

With the mass ``m = a A`` of opacity a and root mean square area A, and the shares ``w_i = m_i /
(m_i + m_j)``, ``w_j = 1 - w_i``, a pair (i, j) becomes k with

    mean        mu_k = w_i mu_i + w_j mu_j
    covariance   S_k = w_i S_i + w_j S_j + w_i w_j (mu_i - mu_j)(mu_i - mu_j)^T
    colour       c_k = w_i c_i + w_j c_j
    opacity      a_k = (a_i P_i + a_j P_j - a_i a_j <G_i, G_j>) / P_k

P is the area of the projection along the thinnest axis of S_k, and <G_i, G_j> the overlap of both
projections, which both members cover and the replacement covers once. If a_k exceeds the maximum
opacity, the area grows instead.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.pruning.merging.covariance import (
    MIN_DIVISOR,
    outer,
    overlap,
    plane_axes,
    projected,
    projected_area,
    rms_area,
    thinnest_axes,
)
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings
from pointsplat_ns.pruning.merging.state import State
from pointsplat_ns.system.pieces import pieces
from pointsplat_ns.system.tensors import numbers
from pointsplat_ns.system.threads import in_threads, in_turn

NEVER = torch.iinfo(torch.int64).max
"""Key of an invalid pair."""


def cheapest_pairs(
    near: Tensor, costs: Tensor, passes: int = MERGING.matching_passes
) -> tuple[Tensor, Tensor, Tensor]:
    """Disjoint pairs of neighbours, cheapest first.

    Ties are broken by hashed indices: with the indices themselves, a row of equal Gaussians would
    yield one pair per pass.

    Args:
        near: (n, k) int32, neighbour indices of each Gaussian; its own index means none.
        costs: (n, k) float32, at least 0, of merging each with each neighbour. If two are
            neighbours of each other, the mean of their two costs counts.
        passes: number of passes.

    Returns:
        First and second members, (E,) int64 each, and costs, (E,) float32; at least one pair if
        there is any neighbour.
    """
    n = len(near)
    device = near.device
    taken = torch.zeros(n, dtype=torch.bool, device=device)

    def free(number: int) -> None:
        """For a block: the rows of free Gaussians with free neighbours, the least key of each, and
        its partner."""
        rows, others, keys, *_ = blocks[number]
        keys.masked_fill_(
            taken[rows] | taken.index_select(0, others.flatten()).view(others.shape), NEVER
        )
        least, slot = keys.min(0)  # amin takes several times as long
        left = (least < NEVER).nonzero()[:, 0]
        partner = others.gather(0, slot[None])[0]
        own = rows[left], others.index_select(1, left), keys.index_select(1, left)
        blocks[number] = *own, least[left], partner[left].long()

    blocks = [*in_turn(lambda here: _pairs(near, costs, here), pieces(n, device, 1 << 14), device)]
    found: list[tuple[Tensor, ...]] = [(numbers(0, device),) * 3]
    for _ in range(passes):
        in_threads(free, range(len(blocks)), device)
        best = torch.full_like(taken, NEVER, dtype=torch.int64)
        for rows, others, keys, least, _ in blocks:
            best[rows] = torch.minimum(best[rows], least)
            best.scatter_reduce_(0, others.flatten().long(), keys.flatten(), "amin")
        for rows, _, _, least, partner in blocks:
            mutual = (least == best[rows]) & (least == best[partner])
            i = rows[mutual]
            j = partner[mutual]
            found.append((i, j, least[mutual]))
            taken[i] = taken[j] = True
    first, second, key = (torch.cat(parts) for parts in zip(*found, strict=True))
    # sorting integers takes a tenth of the time of floats
    prices, order = (key >> 32).int().sort(stable=True)
    return first[order], second[order], prices.view(torch.float32)


def _pairs(near: Tensor, costs: Tensor, here: slice) -> tuple[Tensor, ...]:
    """Rows (m,) int64 of a block of Gaussians, their neighbours (k, m) int32, and the keys (k, m)
    int64 of these pairs.

    A pair of mutual neighbours is in the row of its smaller index. The upper half of a key is the
    cost's bits, because the bits of float32 of at least 0 have the order of the floats. The lower
    half makes all keys different.
    """
    k = near.shape[1]
    rows = numbers(here.stop - here.start, near.device) + here.start
    slots = numbers(k, near.device)
    own = costs[here]
    others = near[here]
    me = rows[:, None].int()
    back = near.index_select(0, others.flatten()).view(-1, k, k) == me[:, :, None]
    theirs = costs.index_select(0, others.flatten()).view(-1, k, k)
    slot = back.to(torch.uint8).argmax(2, keepdim=True)
    mean = ((own + theirs.gather(2, slot)[:, :, 0]) / 2).where(others > me, math.inf)
    once = mean.where(back.any(2), own).where(others != me, math.inf).contiguous()
    # Multiplying by an odd number modulo 2^32 permutes the numbers of pairs (Knuth's multiplicative
    # hashing).
    hashed = ((rows[:, None] * k + slots) * 2654435761) & 0xFFFFFFFF
    key = (once.view(torch.int32).long() << 32) | hashed
    return rows, others.T.contiguous(), key.where(once < math.inf, NEVER).T.contiguous()


class Round(NamedTuple):
    """Result of a round on n Gaussians."""

    place: Tensor  # [n] int32, index of the Gaussian that each became or was merged into
    shares: Tensor  # [n] float32, share of each in that Gaussian's mass


def replace_pairs(
    state: State, first: Tensor, second: Tensor, settings: MergeSettings
) -> tuple[State, Round]:
    """Replace disjoint pairs; a replacement takes the place of the first member.

    Args:
        state: n Gaussians.
        first, second: (E,) each, indices of the members.
        settings: ``max_opacity`` and ``growth_exponent``.

    Returns:
        The state of n - E Gaussians, and the origin of each.
    """
    stays = torch.ones_like(state.counts, dtype=torch.bool)
    stays[second] = False
    place = stays.cumsum(0) - 1
    place[second] = place[first]
    rows = stays.nonzero()[:, 0]
    after = State(
        *in_turn(lambda values: values.index_select(0, rows), [*vars(state).values()], rows.device)
    )
    shares = torch.ones_like(state.weights)

    def replace(part: slice) -> None:
        i = first[part]
        j = second[part]
        k = place[i]
        (ui, ci, ai), (uj, cj, aj) = (
            (state.means[some].double(), state.cov[some].double(), state.alphas[some].double())
            for some in (i, j)
        )
        mi = ai * rms_area(ci)
        mj = aj * rms_area(cj)
        total = mi + mj
        wi = torch.where(total > MIN_DIVISOR, mi / total.clamp_min(MIN_DIVISOR), 0.5)
        wj = 1 - wi
        apart = ui - uj
        after.means[k] = (wi[:, None] * ui + wj[:, None] * uj).to(after.means.dtype)
        cov = wi[:, None] * ci + wj[:, None] * cj + (wi * wj)[:, None] * outer(apart)
        axes = plane_axes(thinnest_axes(cov))
        si, sj, sk = (projected(c, *axes) for c in (ci, cj, cov))
        u, v = ((apart * axis).sum(1) for axis in axes)
        mass = ai * projected_area(si) + aj * projected_area(sj) - ai * aj * overlap(si, sj, u, v)
        alphas = mass.clamp_min(0) / projected_area(sk).clamp_min(MIN_DIVISOR)
        after.cov[k] = (
            (cov * growth(alphas, settings)[:, None]).clamp(-1e30, 1e30).to(after.cov.dtype)
        )
        after.alphas[k] = alphas.clamp_max(settings.max_opacity).to(after.alphas.dtype)
        share = wi.float()
        other = wj.float()
        after.colours[k] = share[:, None] * state.colours[i] + other[:, None] * state.colours[j]
        after.weights[k] = share * state.weights[i] + other * state.weights[j]
        after.counts[k] = state.counts[i] + state.counts[j]
        shares[i] = share
        shares[j] = 1 - share

    # fits into a cache
    in_threads(replace, pieces(len(first), first.device, 1 << 13), first.device)
    return after, Round(place.int(), shares)


def growth(alphas: Tensor, settings: MergeSettings) -> Tensor:
    """Growth factor of the area of Gaussians that need opacities ``alphas``, any shape; 1 up to
    ``max_opacity``. Clamped, because two Gaussians seldom need twice as much, while points without
    area would need an infinite factor."""
    return (alphas / settings.max_opacity).clamp(1, 4.0) ** settings.growth_exponent
