"""Groups of merged Gaussians, the scene of one Gaussian per group, and one factor for sizes.

The right size of a merged Gaussian depends on the overlap of its members and on the background, and
differs between scenes. One factor is chosen by the PSNR against renders of the dense scene.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.geometry.transforms import quaternions_of
from pointsplat_ns.pruning.merging.covariance import MIN_DIVISOR, eigen, unpack, widened
from pointsplat_ns.pruning.merging.pairs import Round
from pointsplat_ns.pruning.merging.settings import MergeSettings
from pointsplat_ns.pruning.merging.state import Participants, State
from pointsplat_ns.rendering.constants import ALPHA_MAX
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.pieces import pieces
from pointsplat_ns.system.tensors import add_rows, numbers
from pointsplat_ns.system.threads import parallel_for, parallel_map


@dataclass(frozen=True, eq=False)
class Groups:
    """n participants in K groups."""

    group: Tensor  # [n] int64, the group of each participant
    shares: Tensor  # [n] float32, share of each participant in its group's mass
    means: Tensor  # [K, 3] float64, scene units
    cov: Tensor  # [K, 6] float64, with blur, squared scene units
    alphas: Tensor  # [K] float64
    counts: Tensor  # [K] int32, number of members

    @classmethod
    def of(cls, participants: Participants, state: State, rounds: Sequence[Round]) -> Groups:
        """The groups that form the Gaussians of a state after the rounds."""
        group = numbers(len(state), state.means.device)
        shares = torch.ones_like(state.weights)
        for place, share in reversed(rounds):
            group = group[place]
            shares = shares[place] * share
        means = state.means.double() * participants.size + participants.centre.to(group.device)
        cov = state.cov.double() * participants.size**2
        return cls(group, shares, means, cov, state.alphas.double(), state.counts)

    @property
    def any_merged(self) -> bool:
        """Whether any group has more than one member."""
        return len(self.group) > len(self.counts)


def scene_maker(
    participants: Participants, groups: Groups, settings: MergeSettings
) -> tuple[Tensor, Callable[[float], Gaussians]]:
    """The scene of K groups, in the order of their first members. A group of one member is that
    member, exact to the bit.

    Returns:
        The group (n,) of each participant, and a function from a size change, which is added to the
        log-scales of merged Gaussians, to the scene.
    """
    # index of each group in the scene
    first = groups.group.new_full((len(groups.counts),), len(participants.scene))
    first, order = first.scatter_reduce_(0, groups.group, participants.members, "amin").sort()
    rank = torch.empty_like(order)
    rank[order] = numbers(len(order), order.device)
    group = rank[groups.group]
    shares = groups.shares
    means, cov, alphas, members = (
        values[order] for values in (groups.means, groups.cov, groups.alphas, groups.counts)
    )
    del groups
    scene = participants.scene
    counts = members.double()
    single = (counts == 1)[:, None]
    least = counts.new_full((len(counts),), MIN_DIVISOR)
    if participants.blurs is not None:
        blurs = add_rows(torch.zeros_like(least), group, shares.double() * participants.blurs)
        blurs *= participants.size**2
        cov = widened(cov, -blurs)
        least = torch.maximum(least, 1e-6 * blurs)
    log_scales, quats = _axes(cov, least, scene.dtype)
    del cov
    means = torch.where(single, scene.means[first], means.to(scene.dtype))
    quats = torch.where(single, scene.quats[first], quats)

    # Merging spreads mass over a larger area, so that more of the background shows through. At 10
    # %, the exponent gains 0.4 dB in flowers, 0.6 in a bouquet and nothing in three other scenes.
    alphas = deepened(alphas, counts, 0.15, settings.max_opacity)
    logits = torch.logit(alphas, 1e-7)[:, None].to(scene.dtype)
    sh = _mean_sh(participants, group, shares, single[:, 0])
    own_scales = scene.scales[first]
    opacities = torch.where(single, scene.opacities[first], logits)

    def make(size_change: float) -> Gaussians:
        scales = torch.where(single, own_scales, (log_scales + size_change).to(scene.dtype))
        return Gaussians(means, scales, quats, opacities, *sh, **scene.traits._asdict())

    return group, make


def deepened(alphas: Tensor, counts: Tensor, exponent: float, max_opacity: float) -> Tensor:
    """Opacities (n,) of Gaussians with ``counts`` (n,) members: 1 - (1 - alpha)^(counts^exponent),
    their optical depth times counts^exponent."""
    depth = -torch.log1p(-alphas.clamp_max(max_opacity)) * counts.double() ** exponent
    return (-torch.expm1(-depth)).clamp_max(ALPHA_MAX)


def _mean_sh(
    participants: Participants, group: Tensor, shares: Tensor, single: Tensor
) -> tuple[Tensor, Tensor]:
    """SH coefficients (K, 3) and (K, (d+1)^2 - 1, 3): means over members with ``shares`` (n,) in
    groups (n,). Groups of one, ``single`` (K,), keep theirs exact to the bit."""
    scene = participants.scene
    wide = torch.promote_types(scene.dtype, torch.float32)
    means = []
    for values in (scene.features_dc, scene.features_rest):
        mean = torch.zeros(len(single), *values.shape[1:], dtype=wide, device=values.device)

        def part(rows: slice, values: Tensor = values) -> tuple[Tensor, ...]:
            own = values[participants.members[rows]].to(wide)
            of_single = single[group[rows]]
            shared = own * shares[rows].to(wide).view(-1, *[1] * (own.dim() - 1))
            return group[rows], shared, group[rows][of_single], own[of_single]

        for groups, shared, singles, own in parallel_map(
            part, pieces(len(group), group.device), group.device
        ):
            add_rows(mean, groups, shared)
            mean[singles] = own
        means.append(mean.to(scene.dtype))
    return means[0], means[1]


def _axes(cov: Tensor, least: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Log-scales (n, 3) float64, and quaternions (n, 4) of a dtype, from covariances (n, 6);
    variances are at least ``least`` (n,)."""
    scales = cov.new_empty(len(cov), 3)
    quats = cov.new_empty(len(cov), 4, dtype=dtype)

    def fill(rows: slice) -> None:
        variances, axes = eigen(unpack(cov[rows]))
        axes[:, :, 0] *= (
            torch.linalg.cross(axes[:, :, 1], axes[:, :, 2])
            .mul_(axes[:, :, 0])
            .sum(1)
            .sign()[:, None]
        )
        # as in covariances(): rounding leaves nothing of thinner axes
        variances = torch.maximum(variances, 1e-10 * variances[:, 2:])
        variances = torch.maximum(variances, least[rows, None])
        scales[rows] = 0.5 * variances.log()
        quats[rows] = quaternions_of(axes).to(dtype)

    parallel_for(fill, pieces(len(cov), cov.device), cov.device)
    return scales, quats


def best_size_change(psnr_of: Callable[[float], float]) -> float:
    """The best size change: of three trials, and the maximum of the parabola through them, which
    may lie slightly outside. ``psnr_of`` returns the PSNR of the scene with a size change, dB."""
    changes = (-0.1, 0.0, 0.05)
    tried = {change: psnr_of(change) for change in changes}
    top = top_of_parabola(changes, list(tried.values()), margin=0.05)
    tried[top] = psnr_of(top)
    return max(tried, key=lambda change: tried[change])


def top_of_parabola(at: tuple[float, float, float], values: list[float], margin: float) -> float:
    """Argument of the maximum of the parabola through three points, at most ``margin`` outside of
    them. Without a maximum, the bound on the side where the values rise, or the best of the three.

    Example:
        >>> round(top_of_parabola((0.0, 1.0, 3.0), [-4.0, -1.0, -1.0], margin=0.0), 6)
        2.0
    """
    (a, b, c) = at
    (p, q, r) = values
    left = (q - p) / (b - a)
    right = (r - q) / (c - b)
    bend = (right - left) / (c - a)
    if bend >= 0 and left * right > 0:
        return c + margin if right > 0 else a - margin
    if bend >= 0 or bend != bend:
        return at[max(range(3), key=lambda index: values[index])]
    top = 0.5 * (a + b) - 0.5 * left / bend
    return min(max(top, a - margin), c + margin)
