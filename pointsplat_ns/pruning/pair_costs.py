"""The cost of replacing a pair of neighbours by one Gaussian: the expected change of rendered images.

Near a surface an image is a blend, sum(a G c) / sum(a G). So a change of one Gaussian counts in proportion to its
colour contrast with its surroundings, and less the more others cover the same place. Where few do, the unknown
background shows through and counts as well. The change is an integral over the projections of three Gaussians onto a
plane. All products of Gaussians have closed integrals.

A pair is looked at from three perpendicular directions: along the thinnest axis of its first member, and from the
sides. They are rounded to thirteen fixed ones, the axes and diagonals of a cube. So every Gaussian is projected once
for each direction, not once for each of its pairs.

Shapes: n Gaussians, k neighbours of each, C colour axes. The projection of a Gaussian onto a plane is called its
shadow: three variances (uu, uv, vv).
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.pruning.covariance import plane
from pointsplat_ns.pruning.merge_state import GROWTH, MOST_SURPLUS, OPAQUE, State
from pointsplat_ns.system.threads import in_threads

LOCAL_CONTRAST = 0.01
"""Contrast with the surroundings assumed in addition to the measured one, per colour channel in [0, 1]."""

BACKGROUND_CONTRAST = 0.3
"""Contrast assumed with the far background, which shows where few Gaussians overlap."""

DIRECTIONS = torch.nn.functional.normalize(
    torch.tensor([way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if way > (0, 0, 0)], dtype=torch.float64)
)
"""The directions (13, 3) that pairs are seen from."""

THINNEST = 1e-5
"""Share of a shadow's summed variances that is added to each, so that float32 tells thin shadows from lines. So widths
are at least 0.3 % of lengths."""

NARROWEST, WIDEST = 1e-6, 1e3
"""Bounds of standard deviations in units of the scene's size: squares of products of four stay in float32."""

FARTHEST = 1e3
"""Bound of coordinates in units of the scene's size."""

CHUNK = 1 << 13
"""Number of Gaussians processed at once: small enough for a processor's cache."""

TINY = 1e-30


def _projections() -> tuple[Tensor, Tensor]:
    """For each direction the two axes of its plane, (13, 3, 2), and the matrix that turns the six numbers of a
    covariance into its shadow, (13, 6, 3)."""
    axes = torch.stack(plane(DIRECTIONS), dim=2)
    u, v = axes[..., 0], axes[..., 1]

    def row(a: Tensor, b: Tensor) -> Tensor:
        x, y, z = a.unbind(1)
        p, q, r = b.unbind(1)
        return torch.stack([x * p, x * q + y * p, x * r + z * p, y * q, y * r + z * q, z * r], dim=1)

    return axes, torch.stack([row(u, u), row(u, v), row(v, v)], dim=2)


def _sides() -> Tensor:
    """(13, 3): each direction, and two that are perpendicular to it and to each other, as far as the thirteen are."""
    across = (DIRECTIONS @ DIRECTIONS.T).abs()
    rows = []
    for face in range(len(DIRECTIONS)):
        one = int(across[face].sort(stable=True).indices[0])
        other = int((across[face] + across[one]).sort(stable=True).indices[0])
        rows.append([face, one, other])
    return torch.tensor(rows)


AXES, TO_SHADOW = _projections()
SIDES = _sides()


def costs_of(state: State, near: Tensor) -> Tensor:
    """Expected change of images by merging each Gaussian with each of its neighbours.

    Args:
        state: n Gaussians.
        near: (n, k) indices of the neighbours of each.

    Returns:
        (n, k) float32: squared colour units times solid angle, with the surroundings of the first of each pair.
    """
    n = len(state)
    means, cov = _scaled(state)
    ways = torch.empty(n, 3, dtype=torch.uint8)
    everywhere = torch.arange(n).split(CHUNK)

    def choose(these: Tensor) -> None:
        shadows = (cov[these] @ TO_SHADOW.permute(1, 0, 2).reshape(6, -1)).view(-1, len(DIRECTIONS), 3)
        areas = shadows[..., 0] * shadows[..., 2] - shadows[..., 1] ** 2
        ways[these] = SIDES[areas.argmax(1)].to(torch.uint8)

    in_threads(choose, everywhere)
    alphas, costs = state.alphas.float(), torch.zeros(near.shape)
    for way in range(len(DIRECTIONS)):
        here = (ways == way).any(1).nonzero()[:, 0]
        if len(here) == 0:
            continue
        centres, shadows = (means @ AXES[way]).float(), (cov @ TO_SHADOW[way]).float()
        spread = THINNEST * (shadows[:, 0] + shadows[:, 2]) + NARROWEST**2
        shadows[:, 0] += spread
        shadows[:, 2] += spread
        seen = Seen(centres, shadows, area_of(shadows), alphas, state.colours)

        def add(these: Tensor, seen: Seen = seen) -> None:
            costs[these] += seen.costs(these, near[these])

        in_threads(add, here.split(CHUNK))
    return costs.mul_(state.weights[:, None])


def _scaled(state: State) -> tuple[Tensor, Tensor]:
    """Means (n, 3) and covariances (n, 6) in units of the scene's size, around its centre, within the bounds."""
    means = ((state.means - state.centre) / state.size).clamp_(-FARTHEST, FARTHEST)
    cov = state.cov / state.size**2
    total = cov[:, 0] + cov[:, 3] + cov[:, 5]
    cov *= (WIDEST**2 / total.clamp_min(WIDEST**2))[:, None]
    return means, cov


def area_of(shadow: Tensor) -> Tensor:
    """Areas (...) of shadows (..., 3), in units of 2 pi: root of the determinant."""
    return (shadow[..., 0] * shadow[..., 2] - shadow[..., 1].square()).clamp_min(TINY).sqrt()


def overlap(first: Tensor, second: Tensor, product: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Integral over the plane of the product of two Gaussians of peak 1 whose centres are (u, v) apart, (...), in units
    of 2 pi.

    The product of two Gaussians is a Gaussian. Its integral is the product of their areas, divided by the area of the
    summed covariance, times exp(-d^2 / 2) with d the Mahalanobis distance of the centres under that covariance.

    Args:
        first, second: shadows (..., 3).
        product: of their areas.
        u, v: from one centre to the other.
    """
    uu, uv, vv = (first + second).unbind(-1)
    squared = (uu * vv - uv * uv).clamp_min(TINY)
    distance = ((vv * u - 2 * uv * v) * u + uu * v * v) / squared
    return product * squared.rsqrt() * torch.exp(-0.5 * distance.clamp_min(0))


@dataclass
class Seen:
    """All Gaussians as seen from one direction."""

    centres: Tensor  # [n, 2]
    shadows: Tensor  # [n, 3]
    areas: Tensor  # [n]
    alphas: Tensor  # [n]
    colours: Tensor  # [n, C]

    def costs(self, i: Tensor, j: Tensor) -> Tensor:
        """Change of the image by each merge of Gaussians ``i`` (m,) with their neighbours ``j`` (m, k), (m, k)."""
        si, pi, ai = self.shadows[i][:, None], self.areas[i][:, None], self.alphas[i][:, None]
        sj, pj, aj = self.shadows[j], self.areas[j], self.alphas[j]
        u, v = (self.centres[i][:, None] - self.centres[j]).unbind(-1)
        oij = overlap(si, sj, pi * pj, u, v)
        # How much covers the first, itself included, and the mean colour of that.
        on = aj * oij / pi
        cover = ai / 2 + on.sum(1, keepdim=True)
        ci, cj = self.colours[i], self.colours[j]
        around = (ai / 2 * ci + (on[:, None] @ cj)[:, 0]) / cover.clamp_min(TINY)
        fi, fj = (ci - around)[:, None], cj - around[:, None]
        # The replacement: common mass, centre and covariance.
        mi, mj = ai * pi, aj * pj
        wi = mi / (mi + mj).clamp_min(TINY)
        wj = 1 - wi
        within = wi * wj
        across = torch.stack([within * u * u, within * u * v, within * v * v], dim=-1)
        sk = wi[..., None] * si + wj[..., None] * sj + across
        pk = area_of(sk)
        ak = (mi + mj - ai * aj * oij).clamp_min(0) / pk
        growth = (ak / OPAQUE).clamp(1, MOST_SURPLUS) ** GROWTH
        sk, pk, ak = sk * growth[..., None], pk * growth, ak.clamp_max(OPAQUE)
        oik, ojk = overlap(si, sk, pi * pk, wj * u, wj * v), overlap(sj, sk, pj * pk, wi * u, wi * v)
        # |f_i a_i G_i + f_j a_j G_j - f_k a_k G_k|^2 over the plane, for features f: f_k is their mean by mass.
        assumed = 3 * LOCAL_CONTRAST**2
        ii, jj = fi.square().sum(-1) + assumed, fj.square().sum(-1) + assumed
        ij = (fi * fj).sum(-1) + assumed
        ik, jk = wi * ii + wj * ij, wj * jj + wi * ij
        kk = wi * ik + wj * jk
        gii, gjj, gkk = ai * ai * pi / 2, aj * aj * pj / 2, ak * ak * pk / 2
        gij, gik, gjk = 2 * ai * aj * oij, 2 * ai * ak * oik, 2 * aj * ak * ojk
        blend = ii * gii + jj * gjj + kk * gkk + ij * gij - ik * gik - jk * gjk
        holes = gii + gjj + gkk + gij - gik - gjk
        through = 3 * BACKGROUND_CONTRAST**2 * torch.exp(-4 * cover)
        return blend.clamp_min(0) / cover.clamp_min(0.5).square() + through * holes.clamp_min(0)
