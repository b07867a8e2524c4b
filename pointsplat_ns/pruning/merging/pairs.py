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

import ctypes
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
from pointsplat_ns.system.kernels import (
    FLOAT_POINTER,
    INT32_POINTER,
    INT64_POINTER,
    KERNELS,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.pieces import pieces
from pointsplat_ns.system.tensors import INDICES, numbers
from pointsplat_ns.system.threads import parallel_for, parallel_map


class MatchingStruct(Struct):
    """``Matching`` of ``pairs.cpp``, which documents its members."""

    members = {
        "near": INT32_POINTER,
        "costs": FLOAT_POINTER,
        "count": ctypes.c_int64,
        "neighbours": ctypes.c_int64,
        "keys": INT64_POINTER,
        "least": INT64_POINTER,
        "partner": INT32_POINTER,
        "best": INT64_POINTER,
        "taken": INT32_POINTER,
        "first": INT64_POINTER,
        "second": INT64_POINTER,
        "found": INT64_POINTER,
        "pairs": INT64_POINTER,
    }
    _fields_ = c_fields(members)


class ReplacingStruct(Struct):
    """``Replacing`` of ``pairs.cpp``, which documents its members."""

    members = {
        "max_opacity": ctypes.c_double,
        "growth_exponent": ctypes.c_double,
        "first": INT64_POINTER,
        "second": INT64_POINTER,
        "place": INT64_POINTER,
        "count": ctypes.c_int64,
        "axes": ctypes.c_int64,
        "means": FLOAT_POINTER,
        "cov": FLOAT_POINTER,
        "alphas": FLOAT_POINTER,
        "colours": FLOAT_POINTER,
        "weights": FLOAT_POINTER,
        "counts": INT32_POINTER,
        "means_after": FLOAT_POINTER,
        "cov_after": FLOAT_POINTER,
        "alphas_after": FLOAT_POINTER,
        "colours_after": FLOAT_POINTER,
        "weights_after": FLOAT_POINTER,
        "counts_after": INT32_POINTER,
        "shares": FLOAT_POINTER,
    }
    _fields_ = c_fields(members)


pair_keys_kernel = Function("pointsplat_pair_keys", MatchingStruct, INT64_POINTER)
least_keys_kernel = Function("pointsplat_least_keys", MatchingStruct, INT64_POINTER)
take_pairs_kernel = Function("pointsplat_take_pairs", MatchingStruct)
replace_pairs_kernel = Function("pointsplat_replace_pairs", ReplacingStruct, INT64_POINTER)

NEVER = torch.iinfo(torch.int64).max
"""Key of an invalid pair."""

MOST_COST = torch.finfo(torch.float32).max
"""In place of NaN and infinite costs: finite, so that every pair can be merged at last."""


def cheapest_pairs(
    near: Tensor,
    costs: Tensor,
    passes: int = MERGING.matching_passes,
    compiled: bool | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Disjoint pairs of neighbours, cheapest first.

    Ties are broken by hashed indices: with the indices themselves, a row of equal Gaussians would
    yield one pair per pass.

    Args:
        near: (n, k) int32, neighbour indices of each Gaussian; its own index means none.
        costs: (n, k) float32, at least 0, of merging each with each neighbour. If two are
            neighbours of each other, the mean of their two costs counts. NaN and infinite costs
            are the highest.
        passes: number of passes.
        compiled: False uses torch; True warns if the kernels are missing.

    Returns:
        First and second members, (E,) int64 each, and costs, (E,) float32; at least one pair if
        there is any neighbour.
    """
    if near.dtype == torch.int32 and KERNELS.usable_for(compiled, costs):
        found = _found_by_kernels(near, costs, passes)
    else:
        found = _found_by_torch(near, costs, passes)
    first, second, key = found
    # sorting integers takes a tenth of the time of floats
    prices, order = (key >> 32).int().sort(stable=True)
    return first[order], second[order], prices.view(torch.float32)


def _found_by_kernels(near: Tensor, costs: Tensor, passes: int) -> list[Tensor]:
    """Members of the pairs of :func:`cheapest_pairs` and their keys, (E,) int64 each, as found."""
    n = len(near)
    most = (torch.empty(n // 2, **INDICES) for _ in range(3))
    found = dict(zip(("first", "second", "found"), most, strict=True))
    number = torch.zeros(1, **INDICES)
    task = MatchingStruct(
        near=near.contiguous(),
        costs=costs.contiguous(),
        count=n,
        neighbours=near.shape[1],
        keys=torch.empty(near.shape, **INDICES),
        least=torch.empty(n, **INDICES),
        partner=torch.empty(n, dtype=torch.int32, device="cpu"),
        best=torch.empty(n, **INDICES),
        taken=torch.zeros(n, dtype=torch.int32, device="cpu"),
        pairs=number,
        **found,
    )
    on_threads(n >= SEVERAL, pair_keys_kernel, task)
    for _ in range(passes):
        on_threads(n >= SEVERAL, least_keys_kernel, task)
        take_pairs_kernel(task)
    return [values[: int(number)] for values in found.values()]


def _found_by_torch(near: Tensor, costs: Tensor, passes: int) -> list[Tensor]:
    """As :func:`_found_by_kernels`."""
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

    blocks = [
        *parallel_map(lambda here: _pairs(near, costs, here), pieces(n, device, 1 << 14), device)
    ]
    found: list[tuple[Tensor, ...]] = [(numbers(0, device),) * 3]
    for _ in range(passes):
        parallel_for(free, range(len(blocks)), device)
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
    return [torch.cat(parts) for parts in zip(*found, strict=True)]


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
    own = _bounded(costs[here])
    others = near[here]
    me = rows[:, None].int()
    back = near.index_select(0, others.flatten()).view(-1, k, k) == me[:, :, None]
    theirs = _bounded(costs.index_select(0, others.flatten())).view(-1, k, k)
    slot = back.to(torch.uint8).argmax(2, keepdim=True)
    mean = (own / 2 + theirs.gather(2, slot)[:, :, 0] / 2).where(others > me, math.inf)
    once = mean.where(back.any(2), own).where(others != me, math.inf).contiguous()
    # Multiplying by an odd number modulo 2^32 permutes the numbers of pairs (Knuth's multiplicative
    # hashing).
    hashed = ((rows[:, None] * k + slots) * 2654435761) & 0xFFFFFFFF
    key = (once.view(torch.int32).long() << 32) | hashed
    return rows, others.T.contiguous(), key.where(once < math.inf, NEVER).T.contiguous()


def _bounded(costs: Tensor) -> Tensor:
    return costs.nan_to_num(nan=MOST_COST, posinf=MOST_COST)


class Round(NamedTuple):
    """Result of a round on n Gaussians."""

    place: Tensor  # [n] int32, index of the Gaussian that each became or was merged into
    shares: Tensor  # [n] float32, share of each in that Gaussian's mass


def replace_pairs(
    state: State,
    first: Tensor,
    second: Tensor,
    settings: MergeSettings,
    compiled: bool | None = None,
) -> tuple[State, Round]:
    """Replace disjoint pairs; a replacement takes the place of the first member.

    Args:
        state: n Gaussians.
        first, second: (E,) each, indices of the members.
        settings: ``max_opacity`` and ``growth_exponent``.
        compiled: False uses torch; True warns if the kernels are missing.

    Returns:
        The state of n - E Gaussians, and the origin of each.
    """
    stays = torch.ones_like(state.counts, dtype=torch.bool)
    stays[second] = False
    place = stays.cumsum(0) - 1
    place[second] = place[first]
    rows = stays.nonzero()[:, 0]
    after = State(
        *parallel_map(
            lambda values: values.index_select(0, rows), [*vars(state).values()], rows.device
        )
    )
    shares = torch.ones_like(state.weights)
    if KERNELS.usable_for(compiled, state.means, state.cov, state.alphas):
        task = ReplacingStruct(
            max_opacity=settings.max_opacity,
            growth_exponent=settings.growth_exponent,
            first=first.contiguous(),
            second=second.contiguous(),
            place=place,
            count=len(first),
            axes=state.colours.shape[1],
            **{name: values.contiguous() for name, values in vars(state).items()},
            **{f"{name}_after": values for name, values in vars(after).items()},
            shares=shares,
        )
        on_threads(len(first) >= SEVERAL, replace_pairs_kernel, task)
        return after, Round(place.int(), shares)

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
    parallel_for(replace, pieces(len(first), first.device, 1 << 13), first.device)
    return after, Round(place.int(), shares)


def growth(alphas: Tensor, settings: MergeSettings) -> Tensor:
    """Growth factor of the area of Gaussians that need opacities ``alphas``, any shape; 1 up to
    ``max_opacity``. Clamped, because two Gaussians seldom need twice as much, while points without
    area would need an infinite factor."""
    return (alphas / settings.max_opacity).clamp(1, 4.0) ** settings.growth_exponent
