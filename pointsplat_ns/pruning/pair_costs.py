"""The replacement of a pair of Gaussians, and the expected change of rendered images.

The replacement has the common mass (opacity times the area of the projection), centre, covariance and colour of both.
The cost is the change expected in images from three directions. Near a surface an image is a blend, sum(a G c) /
sum(a G). So a change of one Gaussian counts in proportion to its colour contrast with its surroundings, and less the
more others cover the same place. Where few do, the unknown background shows through and counts as well.

Shapes: n Gaussians left, E pairs (i, j). The projection of a Gaussian onto a plane is called its shadow.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.pruning.covariance import TINY, flat_area, flatten, normals, outer, overlap, plane, shadow

OPAQUE = 0.99
"""Largest opacity of a replacement. If the mass needs more, the area grows."""

GROWTH = 0.6
"""The area grows with the ratio of needed opacity to :data:`OPAQUE`, to this power: 0 opens holes, 1 smears edges."""

MOST_SURPLUS = 4.0
"""Upper bound of that ratio. Two Gaussians seldom reach 2; for points without area it would be infinite."""

LOCAL_CONTRAST = 0.01
"""Contrast with the surroundings assumed in addition to the measured one, per colour channel in [0, 1]."""

BACKGROUND_CONTRAST = 0.3
"""Contrast assumed with the far background, which shows where few Gaussians overlap."""

FACE_ON, *SIDEWAYS = 0, 1, 2
"""Directions that pairs are seen from. A distance in depth between the members shows only from the sides."""

CHUNK = 1 << 17
"""Number of pairs processed at once: about 100 MB."""


@dataclass
class Remaining:
    """The Gaussians that remain after some rounds; float64, except for the SH."""

    means: Tensor  # [n, 3]
    cov: Tensor  # [n, 6]
    alphas: Tensor  # [n]
    colours: Tensor  # [n, C] on principal axes
    sh: Tensor  # [n, (d+1)^2 * 3]

    def __len__(self) -> int:
        return len(self.means)

    def keep(self, mask: Tensor) -> None:
        self.means, self.cov, self.alphas = self.means[mask], self.cov[mask], self.alphas[mask]
        self.colours, self.sh = self.colours[mask], self.sh[mask]


@dataclass
class Moments:
    """Moments of pairs, independent of the direction that they are seen from."""

    weight: Tensor  # [E] share of i in the mass
    apart: Tensor  # [E, 3] from j to i
    means: Tensor  # [E, 3]
    cov: Tensor  # [E, 6]
    axes: tuple[Tensor, Tensor, Tensor]  # [E, 3] orthonormal, the last near the thinnest axis


@dataclass
class Replacements:
    """The replacements of pairs (i, j), with areas and overlaps of shadows along one direction."""

    means: Tensor  # [E, 3]
    cov: Tensor  # [E, 6]
    alphas: Tensor  # [E]
    weight: Tensor  # [E] share of i in the mass
    areas: tuple[Tensor, Tensor, Tensor]  # [E] shadows of i, j and the merged
    overlaps: tuple[Tensor, Tensor, Tensor]  # [E] of i with j, i with the merged, j with the merged


def moments_of(state: Remaining, i: Tensor, j: Tensor) -> Moments:
    """Moments of the common mass of Gaussians ``i`` (E,) and ``j`` (E,)."""
    mi, mj = (state.alphas[x] * shadow(state.cov[x]) for x in (i, j))
    total = mi + mj
    wi = torch.where(total > TINY, mi / total.clamp_min(TINY), 0.5)
    wj = 1 - wi
    apart = state.means[i] - state.means[j]
    means = wi[:, None] * state.means[i] + wj[:, None] * state.means[j]
    cov = wi[:, None] * state.cov[i] + wj[:, None] * state.cov[j] + (wi * wj)[:, None] * outer(apart)
    normal = normals(cov)
    return Moments(wi, apart, means, cov, (*plane(normal), normal))


def replacements_of(state: Remaining, i: Tensor, j: Tensor, joined: Moments, view: int = FACE_ON) -> Replacements:
    """The replacements of the pairs, seen along their thinnest axis or one of the two perpendicular to it. The opacity
    is such that the mass is that of both members minus their overlap."""
    ai, aj = state.alphas[i], state.alphas[j]
    wi, wj = joined.weight, 1 - joined.weight
    apart, means, cov, axes = joined.apart, joined.means, joined.cov, joined.axes
    e1, e2 = axes[view], axes[(view + 1) % 3]
    si, sj, sk = (flatten(c, e1, e2) for c in (state.cov[i], state.cov[j], cov))
    u, v = (apart * e1).sum(1), (apart * e2).sum(1)
    pi, pj, pk = flat_area(si), flat_area(sj), flat_area(sk)
    oij = overlap(si, sj, u, v)
    alphas = (ai * pi + aj * pj - ai * aj * oij).clamp_min(0) / pk.clamp_min(TINY)
    growth = (alphas / OPAQUE).clamp(1, MOST_SURPLUS) ** GROWTH
    sk, pk, cov = sk * growth[:, None], pk * growth, cov * growth[:, None]
    oik, ojk = overlap(si, sk, wj * u, wj * v), overlap(sj, sk, wi * u, wi * v)
    return Replacements(means, cov, alphas.clamp_max(OPAQUE), wi, (pi, pj, pk), (oij, oik, ojk))


def picture_change(
    pairs: Replacements, ai: Tensor, aj: Tensor, ii: Tensor | float, jj: Tensor | float, ij: Tensor | float
) -> Tensor:
    """Integral over the plane of |f_i a_i G_i + f_j a_j G_j - f_k a_k G_k|^2, (E,). ``ii``, ``jj`` and ``ij`` are the
    scalar products of the features f_i and f_j; f_k is their mean weighted by mass."""
    wi, wj, ak = pairs.weight, 1 - pairs.weight, pairs.alphas
    (pi, pj, pk), (oij, oik, ojk) = pairs.areas, pairs.overlaps
    ik, jk = wi * ii + wj * ij, wj * jj + wi * ij
    kk = wi * ik + wj * jk
    alone = ai * ai * ii * pi + aj * aj * jj * pj + ak * ak * kk * pk
    across = ai * aj * ij * oij - ai * ak * ik * oik - aj * ak * jk * ojk
    return (alone / 2 + 2 * across).clamp_min(0)


def costs_of(state: Remaining, first: Tensor, second: Tensor) -> Tensor:
    """Expected change of images from three directions by each merge, (E,) float32, squared colour units times area."""
    # Pass 1, at each Gaussian and from each side: how much covers it (itself included), and the mean colour of that.
    views = (FACE_ON, *SIDEWAYS)
    covers = [state.alphas / 2 for _ in views]
    arounds = [cover[:, None] * state.colours for cover in covers]
    kept = []
    for i, j in zip(first.split(CHUNK), second.split(CHUNK), strict=True):
        joined = moments_of(state, i, j)
        seen = [replacements_of(state, i, j, joined, view) for view in views]
        for pairs, cover, around in zip(seen, covers, arounds, strict=True):
            (pi, pj, _), (oij, _, _) = pairs.areas, pairs.overlaps
            on_i = state.alphas[j] * oij / pi.clamp_min(TINY)
            on_j = state.alphas[i] * oij / pj.clamp_min(TINY)
            cover.index_add_(0, i, on_i).index_add_(0, j, on_j)
            around.index_add_(0, i, on_i[:, None] * state.colours[j]).index_add_(0, j, on_j[:, None] * state.colours[i])
        none = joined.means[:0]
        kept.append([dataclasses.replace(pairs, means=none, cov=none) for pairs in seen])  # to save memory
    for cover, around in zip(covers, arounds, strict=True):
        around /= cover[:, None].clamp_min(TINY)
    # Pass 2: the change of colour against the surroundings, and of coverage against the background.
    costs = []
    for i, j, seen in zip(first.split(CHUNK), second.split(CHUNK), kept, strict=True):
        cost = torch.zeros_like(seen[0].weight)
        for pairs, cover, around in zip(seen, covers, arounds, strict=True):
            cost += _cost_seen(state, i, j, pairs, cover, around)
        costs.append(cost.float())
    return torch.cat(costs)


def _cost_seen(state: Remaining, i: Tensor, j: Tensor, pairs: Replacements, cover: Tensor, around: Tensor) -> Tensor:
    """:func:`costs_of` from one direction, given how much covers each Gaussian (n,) and its mean colour (n, C)."""
    wi, wj = pairs.weight, 1 - pairs.weight
    here = wi[:, None] * around[i] + wj[:, None] * around[j]
    fi, fj = state.colours[i] - here, state.colours[j] - here
    ii, jj, ij = ((x * y).sum(1) + 3 * LOCAL_CONTRAST**2 for x, y in ((fi, fi), (fj, fj), (fi, fj)))
    ai, aj, one = state.alphas[i], state.alphas[j], torch.ones_like(ii)
    covered = wi * cover[i] + wj * cover[j]
    through = 3 * BACKGROUND_CONTRAST**2 * torch.exp(-4 * covered)
    cost = picture_change(pairs, ai, aj, ii, jj, ij) / covered.clamp_min(0.5) ** 2
    return cost + through * picture_change(pairs, ai, aj, one, one, one)
