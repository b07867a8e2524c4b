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

CHUNK = 1 << 14
"""Number of Gaussians processed at once: about 50 MB."""

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


def costs_of(state: State, near: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """Expected change of images by merging each Gaussian with each of its neighbours.

    Args:
        state: n Gaussians.
        near: (n, k) indices of the neighbours of each.
        dtype: what pairs are computed in; Gaussians are projected in float64.

    Returns:
        (n, k): squared colour units times solid angle, with the surroundings of the first of each pair.
    """
    n = len(state)
    ways = torch.empty(n, 3, dtype=torch.uint8)
    everywhere = torch.arange(n).split(CHUNK)

    def choose(these: Tensor) -> None:
        _, cov = _scaled(state, these)
        shadows = (cov @ TO_SHADOW.permute(1, 0, 2).reshape(6, -1)).view(-1, len(DIRECTIONS), 3)
        areas = shadows[..., 0] * shadows[..., 2] - shadows[..., 1] ** 2
        ways[these] = SIDES[areas.argmax(1)].to(torch.uint8)

    in_threads(choose, everywhere)
    seen = Seen.of(state, dtype)
    costs = torch.zeros(near.shape, dtype=dtype)
    for way in range(len(DIRECTIONS)):
        here = (ways == way).any(1).nonzero()[:, 0]
        if len(here) == 0:
            continue

        def look(these: Tensor, way: int = way) -> None:
            seen.look(state, these, way)

        def add(these: Tensor) -> None:
            costs[these] += seen.costs(these, near[these])

        in_threads(look, everywhere)
        in_threads(add, here.split(CHUNK))
    return costs.mul_(state.weights[:, None])


def _scaled(state: State, these: Tensor) -> tuple[Tensor, Tensor]:
    """Means (m, 3) and covariances (m, 6) of some Gaussians in units of the scene's size, around its centre, within the
    bounds."""
    means = ((state.means[these] - state.centre) / state.size).clamp_(-FARTHEST, FARTHEST)
    cov = state.cov[these] / state.size**2
    total = cov[:, 0] + cov[:, 3] + cov[:, 5]
    cov *= (WIDEST**2 / total.clamp_min(WIDEST**2))[:, None]
    return means, cov


def area_of(uu: Tensor, uv: Tensor, vv: Tensor) -> Tensor:
    """Areas of shadows with these variances, in units of 2 pi: root of the determinant."""
    return (uu * vv).addcmul_(uv, uv, value=-1).clamp_min_(TINY).sqrt_()


def overlap(uu: Tensor, uv: Tensor, vv: Tensor, product: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Integral over the plane of the product of two Gaussians of peak 1 whose centres are (u, v) apart, in units of
    2 pi.

    The product of two Gaussians is a Gaussian. Its integral is the product of their areas, divided by the area of the
    summed covariance, times exp(-d^2 / 2) with d the Mahalanobis distance of the centres under that covariance.

    Args:
        uu, uv, vv: the summed variances.
        product: of the areas.
        u, v: from one centre to the other.
    """
    inverse = (uu * vv).addcmul_(uv, uv, value=-1).clamp_min_(TINY).reciprocal_()
    distance = (vv * u).addcmul_(uv, v, value=-2).mul_(u).addcmul_(uu * v, v).mul_(inverse).clamp_min_(0)
    return distance.mul_(-0.5).exp_().mul_(inverse.sqrt_()).mul_(product)


@dataclass
class Seen:
    """All Gaussians as seen from one direction."""

    plane: Tensor  # [n, 8] centre u, v; variances uu, uv, vv; area; opacity; squared length of the colour
    colours: Tensor  # [n, C]

    @classmethod
    def of(cls, state: State, dtype: torch.dtype) -> Seen:
        """What all directions have in common; :meth:`look` adds the rest."""
        plane, colours = torch.empty(len(state), 8, dtype=dtype), state.colours.to(dtype)
        plane[:, 6], plane[:, 7] = state.alphas, colours.square().sum(1)
        return cls(plane, colours)

    def look(self, state: State, these: Tensor, way: int) -> None:
        """Project some Gaussians."""
        means, cov = _scaled(state, these)
        centres, shadows = ((values @ to).to(self.plane) for values, to in ((means, AXES[way]), (cov, TO_SHADOW[way])))
        spread = THINNEST * (shadows[:, 0] + shadows[:, 2]) + NARROWEST**2
        shadows[:, 0] += spread
        shadows[:, 2] += spread
        self.plane[these, :6] = torch.cat([centres, shadows, area_of(*shadows.unbind(1))[:, None]], dim=1)

    def costs(self, i: Tensor, j: Tensor) -> Tensor:
        """Change of the image by each merge of Gaussians ``i`` (m,) with their neighbours ``j`` (m, k), (m, k)."""
        m, k = j.shape
        flat = j.flatten()
        ui, vi, uui, uvi, vvi, pi, ai, cci = self.plane.index_select(0, i).T.contiguous().view(8, m, 1)
        uj, vj, uuj, uvj, vvj, pj, aj, ccj = self.plane.index_select(0, flat).T.contiguous().view(8, m, k)
        ci, cj = self.colours.index_select(0, i), self.colours.index_select(0, flat).view(m, k, -1)
        u, v = ui - uj, vi - vj
        oij = overlap(uui + uuj, uvi + uvj, vvi + vvj, pi * pj, u, v)
        # How much covers the first, itself included, and the mean colour of that.
        on = aj * oij / pi
        cover = ai / 2 + on.sum(1, keepdim=True)
        around = torch.baddbmm((ai / 2 * ci)[:, None], on[:, None], cj)[:, 0] / cover.clamp_min(TINY)
        # The replacement: common mass, centre and covariance.
        mi, mj = ai * pi, aj * pj
        wi = mi / (mi + mj).clamp_min_(TINY)
        wj = 1 - wi
        wu, wv = wi * wj * u, wi * wj * v
        uuk = (wu * u).addcmul_(wi, uui).addcmul_(wj, uuj)
        uvk = (wu * v).addcmul_(wi, uvi).addcmul_(wj, uvj)
        vvk = (wv * v).addcmul_(wi, vvi).addcmul_(wj, vvj)
        pk = area_of(uuk, uvk, vvk)
        gij = ai * aj * oij
        ak = (mi + mj).sub_(gij).clamp_min_(0).div_(pk)
        if bool((ak > OPAQUE).any()):
            growth = (ak / OPAQUE).clamp_(1, MOST_SURPLUS).pow_(GROWTH)
            uuk, uvk, vvk, pk = uuk * growth, uvk * growth, vvk * growth, pk * growth
            ak = ak.clamp_max_(OPAQUE)
        oik = overlap(uui + uuk, uvi + uvk, vvi + vvk, pi * pk, wj * u, wj * v)
        ojk = overlap(uuj + uuk, uvj + uvk, vvj + vvk, pj * pk, wi * u, wi * v)
        # |f_i a_i G_i + f_j a_j G_j - f_k a_k G_k|^2 over the plane, for features f: f_k is their mean by mass. The
        # products of colours less the one around are written out: no difference is stored for each pair.
        assumed = 3 * LOCAL_CONTRAST**2
        aa, ia = around.square().sum(1, keepdim=True), (ci * around).sum(1, keepdim=True)
        cij, ja = (torch.stack([ci, around], dim=1) @ cj.mT).unbind(1)
        ii = (cci - 2 * ia + aa).clamp_min_(0) + assumed
        jj = ccj.sub(ja, alpha=2).add_(aa).clamp_min_(0).add_(assumed)
        ij = cij.sub_(ja).add_(aa - ia + assumed)
        ik, jk = (wi * ii).addcmul_(wj, ij), (wj * jj).addcmul_(wi, ij)
        kk = (wi * ik).addcmul_(wj, jk)
        gii, gjj, gkk = ai * ai * pi / 2, aj * aj * pj / 2, ak * ak * pk / 2
        gij, gik, gjk = 2 * gij, 2 * ai * ak * oik, 2 * aj * ak * ojk
        blend = (jj * gjj).addcmul_(ii, gii).addcmul_(kk, gkk).addcmul_(ij, gij)
        blend.addcmul_(ik, gik, value=-1).addcmul_(jk, gjk, value=-1).clamp_min_(0)
        holes = (gjj + gii).add_(gkk).add_(gij).sub_(gik).sub_(gjk).clamp_min_(0)
        through = 3 * BACKGROUND_CONTRAST**2 * torch.exp(-4 * cover)
        return blend.div_(cover.clamp_min(0.5).square()).addcmul_(holes, through)
