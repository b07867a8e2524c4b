"""The cost of replacing a pair of neighbours by one Gaussian: the expected change of rendered images.

Near a surface an image is a blend, sum(a G c) / sum(a G). So a change of one Gaussian counts in proportion to its
colour contrast with its surroundings, and less the more others cover the same place. Where few do, the unknown
background shows through and counts as well. The change is an integral over the projections of three Gaussians onto a
plane. All products of Gaussians have closed integrals.

A pair is looked at along the three axes of its first member, so that nothing depends on the axes of the world.

Shapes: n Gaussians, m of them at a time, k neighbours of each, C colour axes. The projection of a Gaussian onto a plane
is called its shadow: three variances (uu, uv, vv).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.pruning.covariance import flatten, normals, plane
from pointsplat_ns.pruning.merge_state import GROWTH, MOST_SURPLUS, OPAQUE, State
from pointsplat_ns.system.threads import in_threads

LOCAL_CONTRAST = 0.01
"""Contrast with the surroundings assumed in addition to the measured one, per colour channel in [0, 1]."""

BACKGROUND_CONTRAST = 0.3
"""Contrast assumed with the far background, which shows where few Gaussians overlap."""

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

PLANES = ((1, 2), (0, 2), (0, 1))
"""Pairs of axes; a plane is seen along the axis that is left out."""

SIX = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Rows and columns of the six numbers of a covariance."""


def costs_of(state: State, near: Tensor) -> Tensor:
    """Expected change of images by merging each Gaussian with each of its neighbours.

    Args:
        state: n Gaussians.
        near: (n, k) indices of the neighbours of each.

    Returns:
        (n, k) float32: squared colour units times solid angle, with the surroundings of the first of each pair.
    """
    means, cov = _scaled(state)
    alphas, colours = state.alphas.float(), state.colours
    lengths, costs = colours.square().sum(1), torch.zeros(near.shape)

    def add(these: Tensor) -> None:
        (m, k), flat = near[these].shape, near[these].flatten()
        axes = own_axes(cov[these])
        apart = ((means[these][:, None] - means.index_select(0, flat).view(m, k, 3)) @ axes).float()
        turn = _turn(axes)
        first = (cov[these][:, None] @ turn).float()  # (m, 1, 6)
        second = (cov.index_select(0, flat).view(m, k, 6) @ turn).float()
        paints = (
            Paint(alphas[these][:, None], colours[these][:, None], lengths[these][:, None]),
            Paint(alphas[flat].view(m, k), colours.index_select(0, flat).view(m, k, -1), lengths[flat].view(m, k)),
        )
        for u, v in PLANES:
            shadows = _shadow(first, u, v), _shadow(second, u, v)
            costs[these] += change(*shadows, *paints, apart[..., u], apart[..., v])

    in_threads(add, torch.arange(len(state)).split(CHUNK))
    return costs.mul_(state.weights[:, None])


def _scaled(state: State) -> tuple[Tensor, Tensor]:
    """Means (n, 3) and covariances (n, 6) in units of the scene's size, around its centre, within the bounds."""
    means = ((state.means - state.centre) / state.size).clamp_(-FARTHEST, FARTHEST)
    cov = state.cov / state.size**2
    total = cov[:, 0] + cov[:, 3] + cov[:, 5]
    cov *= (WIDEST**2 / total.clamp_min(WIDEST**2))[:, None]
    return means, cov


def own_axes(cov: Tensor) -> Tensor:
    """Axes of Gaussians with covariances (m, 6), as columns (m, 3, 3): the thinnest, the longest and the one across.
    Axes of equal length are any."""
    thin = normals(cov)
    u, v = plane(thin)
    uu, uv, vv = flatten(cov, u, v).unbind(1)
    angle = 0.5 * torch.atan2(2 * uv, uu - vv)[:, None]
    long = angle.cos() * u + angle.sin() * v
    return torch.stack([thin, long, torch.linalg.cross(thin, long)], dim=2)


def _turn(axes: Tensor) -> Tensor:
    """Matrices (m, 6, 6) that turn the six numbers of covariances to those along ``axes`` (m, 3, 3)."""
    turn = axes.new_empty(len(axes), 6, 6)
    for to, (p, q) in enumerate(SIX):
        for of, (a, b) in enumerate(SIX):
            both = axes[:, a, p] * axes[:, b, q]
            turn[:, of, to] = both if a == b else both + axes[:, b, p] * axes[:, a, q]
    return turn


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


class Shadow(NamedTuple):
    """Shadows of Gaussians, each (m, k), or (m, 1) for the first members of pairs."""

    uu: Tensor
    uv: Tensor
    vv: Tensor
    area: Tensor


class Paint(NamedTuple):
    """What Gaussians look like, but for their shape; k is 1 for the first members of pairs."""

    alphas: Tensor  # [m, k]
    colours: Tensor  # [m, k, C]
    lengths: Tensor  # [m, k] squared length of the colour


def _shadow(six: Tensor, u: int, v: int) -> Shadow:
    """Shadows on the plane of two axes of covariances (..., 6) along these axes."""
    uu, uv, vv = (six[..., SIX.index(which)] for which in ((u, u), (u, v), (v, v)))
    spread = THINNEST * (uu + vv) + NARROWEST**2
    uu, vv = uu + spread, vv + spread
    return Shadow(uu, uv, vv, area_of(uu, uv, vv))


def change(si: Shadow, sj: Shadow, first: Paint, second: Paint, u: Tensor, v: Tensor) -> Tensor:
    """Change of the image by each merge of Gaussians with their neighbours, (m, k).

    Args:
        si, sj: shadows of the Gaussians, and of their neighbours.
        first, second: what they look like.
        u, v: from the centres of neighbours to those of the Gaussians, (m, k) each.
    """
    uui, uvi, vvi, pi = si
    uuj, uvj, vvj, pj = sj
    (ai, ci, cci), (aj, cj, ccj) = first, second
    ci = ci[:, 0]
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
