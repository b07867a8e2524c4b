"""What a pair costs: the expected change of pictures when neighbours i and j are replaced by one Gaussian k.

All three are projected onto a plane, as ``a G(x)`` with opacity a, ``G(x) = exp(-x^T S^-1 x / 2)`` and area A. Near a
surface a picture is a blend, sum(a G c) / sum(a G). So a change of one Gaussian counts by its colour f relative to its
surroundings, and counts less the more others cover the same place. Where few do, the unknown background shows through
and counts as well:

    cost(i, j) = W_i * sum over three directions of  g^2 (E / max(cover_i, c_min)^2 + H * 3 b^2 exp(-d cover_i))

    E       = integral of |f_i a_i G_i + f_j a_j G_j - f_k a_k G_k|^2 + 3 c_0^2 H      change of colour
    H       = integral of (a_i G_i + a_j G_j - a_k G_k)^2                              change of cover
    g       = A_k / (A_i + A_j)                                                        growth of the area
    f       = colour - surroundings_i,   f_k = w_i f_i + w_j f_j
    cover_i = a_i / 2 + sum over neighbours j of a_j <G_i, G_j> / A_i                  mean of sum(a G) over G_i
    surroundings_i = the mean colour of that cover

The factor g^2 is empirical: E and H do not see how a large replacement blurs what is merged with it later. On five
scenes it gains 0.2 dB at 10 % and 0.3 at 30 %, and viewers draw 6 % fewer Gaussians on a pixel; g^3 loses with poses.

W_i is the visibility weight of i. c_0, b, c_min and d are ``min_contrast``, ``background_contrast``, ``min_cover`` and
``background_decay`` of the settings. The replacement has the common mass, centre and covariance, as in
:mod:`~pointsplat_ns.merging.replacement`, with areas in the plane. All integrals are sums of overlaps, which
have a closed form:

    <G_p, G_q> = integral of G_p G_q = A_p A_q / A_pq * exp(-d_pq^2 / 2),   <G_p, G_p> = A_p / 2

A_pq is the area of the summed covariance S_p + S_q, and d_pq the Mahalanobis distance of the centres under it.

A compiled kernel (``pair_cost.cpp``) does all of it where it was built, in float32. In torch below, E and H are
written out in these overlaps: no difference of pictures or of colours is stored for each pair.

Shapes: n Gaussians, m of them at once, k neighbours of each, C colour axes.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.merging import projections as planes
from pointsplat_ns.merging.projections import DIRECTIONS, PROJECTION_LIMITS, Projections, area_of, directions_of
from pointsplat_ns.merging.replacement import growth
from pointsplat_ns.merging.settings import MERGING, MergeSettings
from pointsplat_ns.merging.state import State
from pointsplat_ns.system.kernels import SEVERAL, Kernels, Struct, agreement, on_threads
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES
from pointsplat_ns.system.threads import in_threads, most_threads

GAUSSIANS_AT_ONCE = 1 << 14
"""Number of Gaussians whose pairs are computed at once: about 50 MB."""


def pair_costs(
    state: State,
    near: Tensor,
    settings: MergeSettings = MERGING,
    dtype: torch.dtype = torch.float32,
    compiled: bool | None = None,
) -> Tensor:
    """Expected change of pictures by merging each Gaussian with each of its neighbours.

    Args:
        state: n Gaussians.
        near: (n, k) indices of the neighbours of each.
        settings: contrasts and cover of the cost, growth of the replacement.
        dtype: precision of the costs; torch projects Gaussians in float64.
        compiled: False leaves it to torch; True warns if there are no kernels.

    Returns:
        (n, k): squared colour units times solid angle, with the surroundings of the first of each pair.
    """
    # the largest numbers of neighbours and of colour axes that the kernel is made for
    fits = near.shape[1] <= 32 and state.colours.shape[1] <= 16 and near.dtype == torch.int32
    if fits and dtype == torch.float32 and KERNELS.usable_for(compiled, state.means):
        return _by_kernels(state, near, settings)
    n = len(state)
    directions = torch.empty(n, 3, dtype=torch.uint8, device="cpu")
    everyone = torch.arange(n, **INDICES).split(GAUSSIANS_AT_ONCE)

    def choose(rows: Tensor) -> None:
        directions[rows] = directions_of(state, rows).to(torch.uint8)

    in_threads(choose, everyone, near.device)
    projections = Projections.empty(state, dtype)
    costs = torch.zeros(near.shape, dtype=dtype, device="cpu")
    for direction in range(len(DIRECTIONS)):
        compared = (directions == direction).any(1).nonzero()[:, 0]
        if len(compared) == 0:
            continue

        def fill(rows: Tensor, direction: int = direction) -> None:
            projections.fill(state, rows, direction)

        def add(rows: Tensor) -> None:
            costs[rows] += costs_in_plane(projections, rows, near[rows], settings)

        in_threads(fill, everyone, near.device)
        in_threads(add, compared.split(GAUSSIANS_AT_ONCE), near.device)
    return costs.mul_(state.weights[:, None])


class Flat(NamedTuple):
    """Gaussians in a plane: the columns of :class:`Projections`, (m, 1) or (m, k) each."""

    u: Tensor
    v: Tensor
    uu: Tensor
    uv: Tensor
    vv: Tensor
    area: Tensor
    alpha: Tensor
    squared_colour: Tensor


class Replacement(NamedTuple):
    """Replacements of pairs in a plane, (m, k) each."""

    wi: Tensor  # share of the first member in the mass
    wj: Tensor
    uu: Tensor
    uv: Tensor
    vv: Tensor
    area: Tensor
    alpha: Tensor


def costs_in_plane(projections: Projections, i: Tensor, j: Tensor, settings: MergeSettings) -> Tensor:
    """The cost in one direction of merging Gaussians ``i`` (m,) with their neighbours ``j`` (m, k), without visibility
    weights, (m, k)."""
    m, k = j.shape
    neighbours = j.flatten()
    first = Flat(*projections.table.index_select(0, i).T.contiguous().view(8, m, 1))
    second = Flat(*projections.table.index_select(0, neighbours).T.contiguous().view(8, m, k))
    ci = projections.colours.index_select(0, i)
    cj = projections.colours.index_select(0, neighbours).view(m, k, -1)
    u, v = first.u - second.u, first.v - second.v
    oij = overlap_of_sum(
        first.uu + second.uu, first.uv + second.uv, first.vv + second.vv, first.area * second.area, u, v
    )
    cover, surroundings = _surroundings(first, second, oij, ci, cj)
    both = first.alpha * second.alpha * oij
    merged = _replacement(first, second, u, v, both, settings)
    oik, ojk = (
        overlap_of_sum(one.uu + merged.uu, one.uv + merged.uv, one.vv + merged.vv, one.area * merged.area, w * u, w * v)
        for one, w in ((first, merged.wj), (second, merged.wi))
    )
    products = _colour_products(first, second, ci, cj, surroundings, settings)
    colour_change, cover_change = _changes(first, second, merged, both, oik, ojk, products)
    holes = 3 * settings.background_contrast**2 * torch.exp(-settings.background_decay * cover)
    change = colour_change.div_(cover.clamp_min(settings.min_cover).square()).addcmul_(cover_change, holes)
    return change.mul_((merged.area / (first.area + second.area)).clamp_max_(PROJECTION_LIMITS.max_growth).square_())


def overlap_of_sum(uu: Tensor, uv: Tensor, vv: Tensor, areas: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Overlap of two projections, in units of 2 pi; the fast form of
    :func:`~pointsplat_ns.merging.covariance.overlap`, for covariances that are not nearly lines.

    Args:
        uu, uv, vv: summed covariance.
        areas: product of both areas.
        u, v: from one centre to the other.
    """
    inverse = (uu * vv).addcmul_(uv, uv, value=-1).clamp_min_(PROJECTION_LIMITS.min_divisor).reciprocal_()
    distance = (vv * u).addcmul_(uv, v, value=-2).mul_(u).addcmul_(uu * v, v).mul_(inverse).clamp_min_(0)
    return distance.mul_(-0.5).exp_().mul_(inverse.sqrt_()).mul_(areas)


def _surroundings(first: Flat, second: Flat, oij: Tensor, ci: Tensor, cj: Tensor) -> tuple[Tensor, Tensor]:
    """Cover (m, 1) of each first member by itself and its neighbours, and the mean colour (m, C) of that."""
    on_first = second.alpha * oij / first.area
    cover = first.alpha / 2 + on_first.sum(1, keepdim=True)
    colour = torch.baddbmm((first.alpha / 2 * ci)[:, None], on_first[:, None], cj)[:, 0]
    return cover, colour / cover.clamp_min(PROJECTION_LIMITS.min_divisor)


def _replacement(first: Flat, second: Flat, u: Tensor, v: Tensor, both: Tensor, settings: MergeSettings) -> Replacement:
    """The replacement of each pair, whose centres are (u, v) apart and which covers ``both`` twice."""
    mi, mj = first.alpha * first.area, second.alpha * second.area
    wi = mi / (mi + mj).clamp_min_(PROJECTION_LIMITS.min_divisor)
    wj = 1 - wi
    wu, wv = wi * wj * u, wi * wj * v
    uu = (wu * u).addcmul_(wi, first.uu).addcmul_(wj, second.uu)
    uv = (wu * v).addcmul_(wi, first.uv).addcmul_(wj, second.uv)
    vv = (wv * v).addcmul_(wi, first.vv).addcmul_(wj, second.vv)
    area = area_of(uu, uv, vv)
    alpha = (mi + mj).sub_(both).clamp_min_(0).div_(area)
    if bool((alpha > settings.max_opacity).any()):
        factor = growth(alpha, settings)
        uu, uv, vv, area = uu * factor, uv * factor, vv * factor, area * factor
        alpha = alpha.clamp_max_(settings.max_opacity)
    return Replacement(wi, wj, uu, uv, vv, area, alpha)


def _colour_products(
    first: Flat, second: Flat, ci: Tensor, cj: Tensor, surroundings: Tensor, settings: MergeSettings
) -> tuple[Tensor, Tensor, Tensor]:
    """<f_i, f_i> (m, 1), <f_j, f_j> and <f_i, f_j> (m, k), each with the contrast 3 c_0^2 that is assumed."""
    assumed = 3 * settings.min_contrast**2
    rr = surroundings.square().sum(1, keepdim=True)
    ir = (ci * surroundings).sum(1, keepdim=True)
    ij, jr = (torch.stack([ci, surroundings], dim=1) @ cj.mT).unbind(1)
    return (
        (first.squared_colour - 2 * ir + rr).clamp_min_(0) + assumed,
        second.squared_colour.sub(jr, alpha=2).add_(rr).clamp_min_(0).add_(assumed),
        ij.sub_(jr).add_(rr - ir + assumed),
    )


def _changes(
    first: Flat,
    second: Flat,
    merged: Replacement,
    both: Tensor,
    oik: Tensor,
    ojk: Tensor,
    products: tuple[Tensor, Tensor, Tensor],
) -> tuple[Tensor, Tensor]:
    """E and H of each pair, (m, k), from the six overlaps and the six products of colours."""
    ii, jj, ij = products
    ik, jk = (merged.wi * ii).addcmul_(merged.wj, ij), (merged.wj * jj).addcmul_(merged.wi, ij)
    kk = (merged.wi * ik).addcmul_(merged.wj, jk)
    gii, gjj, gkk = (one.alpha * one.alpha * one.area / 2 for one in (first, second, merged))
    gij, gik, gjk = 2 * both, 2 * first.alpha * merged.alpha * oik, 2 * second.alpha * merged.alpha * ojk
    colour = (jj * gjj).addcmul_(ii, gii).addcmul_(kk, gkk).addcmul_(ij, gij)
    colour.addcmul_(ik, gik, value=-1).addcmul_(jk, gjk, value=-1).clamp_min_(0)
    cover = (gjj + gii).add_(gkk).add_(gij).sub_(gik).sub_(gjk).clamp_min_(0)
    return colour, cover


def _by_kernels(state: State, near: Tensor, settings: MergeSettings) -> Tensor:
    """As :func:`pair_costs`, float32."""
    count, library = len(state), KERNELS.library
    costs = torch.empty(near.shape, **FLOATS)
    limits = KERNELS.structs["Limits"](**vars(PROJECTION_LIMITS))
    task = KERNELS.structs["Costs"](
        planes=_planes(), limits=limits, contrasts=_contrasts(settings), means=state.means, cov=state.cov,
        alphas=state.alphas, colours=state.colours.contiguous(), weights=state.weights, count=count,
        axes=state.colours.shape[1], neighbours=near.shape[1], table=torch.empty(count, 12, **FLOATS),
        near=near.contiguous(), costs=costs,
    )  # fmt: skip
    for function in (library.pointsplat_projected, library.pointsplat_pair_costs):
        on_threads(count >= SEVERAL, function, task, threads=most_threads())
    return costs


def _planes() -> Struct:
    tables = {"axes": planes.PLANE_AXES, "to_plane": planes.TO_PLANE, "triples": planes.TRIPLES}
    return KERNELS.structs["Planes"](**{name: tuple(table.flatten().tolist()) for name, table in tables.items()})


def _contrasts(settings: MergeSettings) -> Struct:
    names = ("min_contrast", "background_contrast", "background_decay", "min_cover", "max_opacity", "growth_exponent")
    values = {name: getattr(settings, name) for name in (*names, "max_growth_ratio")}
    return KERNELS.structs["Contrasts"](channels=3, **values)


def _as_torch() -> bool:
    """Whether the kernels compute the costs of some pairs as torch does."""
    generator = torch.Generator().manual_seed(0)
    count = 90

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, **FLOATS)

    factors = 0.1 * random(count, 3, 3)
    cov = (factors @ factors.mT).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    state = State(
        means=random(count, 3) - 0.5, cov=cov, alphas=random(count), colours=random(count, 5),
        weights=random(count), counts=torch.ones(count, dtype=torch.int32, device="cpu"),
        centre=torch.zeros(3, **DOUBLES), size=1.0,
    )  # fmt: skip
    near = torch.randint(count, (count, 9), generator=generator, dtype=torch.int32, device="cpu")
    ours, torchs = _by_kernels(state, near, MERGING), pair_costs(state, near, compiled=False)
    return agreement([ours], [torchs], off=1e-4, share=1e-2)


KERNELS = Kernels("merging", Path(__file__).with_name("pair_cost.cpp"), _as_torch)
