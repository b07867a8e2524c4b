"""What a pair becomes: one Gaussian of the pair's common mass, centre, covariance and colour.

With the mass ``m = a A`` of opacity a and root mean square area A, and the shares ``w_i = m_i / (m_i + m_j)``,
``w_j = 1 - w_i``, a pair (i, j) becomes k with

    mean        mu_k = w_i mu_i + w_j mu_j
    covariance   S_k = w_i S_i + w_j S_j + w_i w_j (mu_i - mu_j)(mu_i - mu_j)^T
    colour       c_k = w_i c_i + w_j c_j
    opacity      a_k = (a_i P_i + a_j P_j - a_i a_j <G_i, G_j>) / P_k

P is the area of the projection along the thinnest axis of S_k, and <G_i, G_j> the overlap of both projections, which
both members cover and the replacement covers once. Where a_k is above the largest opacity, the area grows instead.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.merging.covariance import (
    MIN_DIVISOR,
    outer,
    overlap,
    plane_axes,
    projected,
    projected_area,
    rms_area,
    thinnest_axes,
)
from pointsplat_ns.merging.settings import MergeSettings
from pointsplat_ns.merging.state import OF_EACH, State
from pointsplat_ns.system.tensors import FLAGS, FLOATS, INDICES


class Round(NamedTuple):
    """What a round made of n Gaussians."""

    place: Tensor  # [n] int32, index of the Gaussian that each became or was merged into
    shares: Tensor  # [n] float32, of each in that one's mass


def replace_pairs(state: State, first: Tensor, second: Tensor, settings: MergeSettings) -> tuple[State, Round]:
    """Replace disjoint pairs, each in the place of its first member.

    Args:
        state: n Gaussians.
        first, second: (E,) each, indices of the members.
        settings: ``max_opacity`` and ``growth_exponent``.

    Returns:
        The state of n - E Gaussians, and which of the n they were.
    """
    stays = torch.ones(len(state), **FLAGS)
    stays[second] = False
    place = stays.cumsum(0) - 1
    place[second] = place[first]
    rows = stays.nonzero()[:, 0]
    after = replace(state, **{name: getattr(state, name).index_select(0, rows) for name in OF_EACH})
    shares = torch.ones(len(state), **FLOATS)
    for part in torch.arange(len(first), **INDICES).split(1 << 13):  # these fit into a cache
        i, j = first[part], second[part]
        k = place[i]
        wi, *replacements = _replacements(state, i, j, settings)
        for into, values in zip((after.means, after.cov, after.alphas), replacements, strict=True):
            into[k] = values.to(into.dtype)
        share = wi.float()
        other = (1 - wi).float()
        after.colours[k] = share[:, None] * state.colours[i] + other[:, None] * state.colours[j]
        after.weights[k] = share * state.weights[i] + other * state.weights[j]
        after.counts[k] = state.counts[i] + state.counts[j]
        shares[i], shares[j] = share, 1 - share
    return after, Round(place.int(), shares)


def _replacements(state: State, i: Tensor, j: Tensor, settings: MergeSettings) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Share of the first member, mean, covariance and opacity of the replacements of pairs (m,), (m,), float64."""
    (ui, ci, ai), (uj, cj, aj) = (
        (state.means[rows].double(), state.cov[rows].double(), state.alphas[rows].double()) for rows in (i, j)
    )
    mi, mj = ai * rms_area(ci), aj * rms_area(cj)
    total = mi + mj
    wi = torch.where(total > MIN_DIVISOR, mi / total.clamp_min(MIN_DIVISOR), 0.5)
    wj = 1 - wi
    apart = ui - uj
    mean = wi[:, None] * ui + wj[:, None] * uj
    cov = wi[:, None] * ci + wj[:, None] * cj + (wi * wj)[:, None] * outer(apart)
    axes = plane_axes(thinnest_axes(cov))
    si, sj, sk = (projected(c, *axes) for c in (ci, cj, cov))
    u, v = ((apart * axis).sum(1) for axis in axes)
    mass = ai * projected_area(si) + aj * projected_area(sj) - ai * aj * overlap(si, sj, u, v)
    alphas = mass.clamp_min(0) / projected_area(sk).clamp_min(MIN_DIVISOR)
    return wi, mean, enlarged(cov, alphas, settings).clamp(-1e30, 1e30), alphas.clamp_max(settings.max_opacity)


def enlarged(cov: Tensor, alphas: Tensor, settings: MergeSettings) -> Tensor:
    """Covariances (n, 6) with the area that needed opacities (n,) above ``max_opacity`` ask for."""
    return cov * growth(alphas, settings)[:, None]


def growth(alphas: Tensor, settings: MergeSettings) -> Tensor:
    """Factor of the area of Gaussians that need opacities ``alphas``, any shape; 1 up to ``max_opacity``. Two Gaussians
    seldom need twice as much; of points without area it would be infinite."""
    return (alphas / settings.max_opacity).clamp(1, 4.0) ** settings.growth_exponent
