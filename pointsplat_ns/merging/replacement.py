"""What a pair becomes: one Gaussian of the pair's common mass, centre, covariance and colour.

With the mass ``m = a A`` of opacity a and root mean square area A, and the shares ``w_i = m_i / (m_i + m_j)``,
``w_j = 1 - w_i``, a pair (i, j) becomes k with

    mean        mu_k = w_i mu_i + w_j mu_j
    covariance   S_k = w_i S_i + w_j S_j + w_i w_j (mu_i - mu_j)(mu_i - mu_j)^T
    colour       c_k = w_i c_i + w_j c_j
    opacity      a_k = (a_i P_i + a_j P_j - a_i a_j <G_i, G_j>) / P_k

P is the area of the projection along the thinnest axis of S_k, and <G_i, G_j> the overlap of both projections, which
both members cover and the replacement covers once. Where a_k is above the largest opacity, the area grows instead. A
compiled kernel (``replacement.cpp``) computes it, or torch.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.merging.covariance import (
    MIN_DIVISOR,
    outer,
    overlap,
    pack,
    plane_axes,
    projected,
    projected_area,
    rms_area,
    thinnest_axes,
)
from pointsplat_ns.merging.settings import MERGING, MergeSettings
from pointsplat_ns.merging.state import State, bounded
from pointsplat_ns.system.kernels import SEVERAL, Kernels, on_threads
from pointsplat_ns.system.pieces import CHUNK
from pointsplat_ns.system.tensors import FLAGS, FLOATS, INDICES
from pointsplat_ns.system.threads import most_threads


def replace_pairs(
    state: State, first: Tensor, second: Tensor, settings: MergeSettings, compiled: bool | None = None
) -> tuple[State, Tensor]:
    """Replace disjoint pairs, each in the place of its first member.

    Args:
        state: n Gaussians.
        first, second: (E,) each, indices of the members.
        settings: ``max_opacity``, ``growth_exponent``, ``max_growth_ratio``.
        compiled: False leaves it to torch; True warns if there is no kernel.

    Returns:
        The state of n - E Gaussians, and the share of the first member in each pair's mass, (E,) float32.
    """
    if KERNELS.usable_for(compiled, state.means):
        return _by_kernels(state, first, second, settings)
    stays = torch.ones(len(state), **FLAGS)
    stays[second] = False
    place = stays.cumsum(0) - 1
    after = replace(
        state,
        means=state.means[stays],
        cov=state.cov[stays],
        alphas=state.alphas[stays],
        colours=state.colours[stays],
        weights=state.weights[stays],
        counts=state.counts[stays],
    )
    shares = torch.empty(len(first), **FLOATS)
    for part in torch.arange(len(first), **INDICES).split(CHUNK):
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
        shares[part] = share
    return after, shares


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
    return wi, mean, bounded(enlarged(cov, alphas, settings)), alphas.clamp_max(settings.max_opacity)


def enlarged(cov: Tensor, alphas: Tensor, settings: MergeSettings) -> Tensor:
    """Covariances (n, 6) with the area that needed opacities (n,) above ``max_opacity`` ask for."""
    return cov * growth(alphas, settings)[:, None]


def growth(alphas: Tensor, settings: MergeSettings) -> Tensor:
    """Factor of the area of Gaussians that need opacities ``alphas``, any shape; 1 up to ``max_opacity``."""
    return (alphas / settings.max_opacity).clamp(1, settings.max_growth_ratio) ** settings.growth_exponent


def _by_kernels(state: State, first: Tensor, second: Tensor, settings: MergeSettings) -> tuple[State, Tensor]:
    """As :func:`replace_pairs`."""
    n, count = len(state), len(state) - len(first)
    partner = torch.full((n,), -1, **INDICES)
    partner[first] = second
    stays = torch.ones(n, **FLAGS)
    stays[second] = False
    source = stays.nonzero()[:, 0]
    names = ("means", "cov", "alphas", "colours", "weights", "counts")
    before = {name: getattr(state, name).contiguous() for name in names}
    after = {name: values.new_empty(count, *values.shape[1:]) for name, values in before.items()}
    shares = torch.empty(count, **FLOATS)
    remaining = KERNELS.structs["Remaining"]
    task = KERNELS.structs["Replacing"](
        before=remaining(**before), after=remaining(**after), source=source, partner=partner[source], count=count,
        axes=state.colours.shape[1], min_divisor=MIN_DIVISOR, max_opacity=settings.max_opacity,
        growth_exponent=settings.growth_exponent, max_growth_ratio=settings.max_growth_ratio, shares=shares,
    )  # fmt: skip
    on_threads(count >= SEVERAL, KERNELS.library.pointsplat_replace, task, threads=most_threads())
    return replace(state, **after), shares[(stays.cumsum(0) - 1)[first]]


def _as_torch() -> bool:
    """Whether the kernel replaces some pairs as torch does."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, **FLOATS)

    factors = random(90, 3, 3)
    state = State(
        random(90, 3), pack(factors @ factors.mT).contiguous(), random(90), random(90, 5), random(90),
        torch.ones(90, dtype=torch.int32, device="cpu"), torch.zeros(3, **FLOATS), 1.0,
    )  # fmt: skip
    first, second = torch.randperm(90, generator=generator, device="cpu")[:60].view(2, 30)
    found = [_by_kernels(state, first, second, MERGING), replace_pairs(state, first, second, MERGING, False)]
    ours, torchs = ([after.means, after.cov, after.alphas, after.colours, shares] for after, shares in found)
    return all(torch.allclose(a, b, rtol=1e-5, atol=1e-7) for a, b in zip(ours, torchs, strict=True))


KERNELS = Kernels("merging", Path(__file__).with_name("replacement.cpp"), _as_torch)
