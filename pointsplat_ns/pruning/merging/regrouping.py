"""How groups are regrouped: each member changes to the group near it that it fits best.

Pairs are merged from the bottom up and are never separated. So some members end in a group whose other members lie
elsewhere. As in k-means, each member then changes to the group that it fits best, and the groups are computed anew:
hard EM of a mixture of Gaussians whose data are Gaussians (Vasconcelos and Lippman, Learning mixture hierarchies, NIPS
1998). A member with mean mu, covariance S and colour c fits a group with mu_g, S_g and c_g by

    fit = 1/2 (tr(S_g^-1 (S + (mu - mu_g)(mu - mu_g)^T)) + log det S_g) + |c - c_g|^2 / (2 contrast^2)

The less, the better: the expected negative log-density of the group over the member, and the difference of colour. The
mass of a member, by which the moments of a group are weighted, is opacity times root mean square area. A compiled
kernel (``regrouping.cpp``) compares groups, or torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.neighbours import nearest_of
from pointsplat_ns.pruning.merging.covariance import MIN_DIVISOR, covariances_of, outer, rms_area, unpack
from pointsplat_ns.pruning.merging.groups import Groups, first_members
from pointsplat_ns.pruning.merging.participants import Participants
from pointsplat_ns.pruning.merging.replacement import enlarged
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings
from pointsplat_ns.pruning.merging.state import bounded_colours
from pointsplat_ns.system.kernels import SEVERAL, Kernels, on_threads
from pointsplat_ns.system.pieces import CHUNK, in_pieces
from pointsplat_ns.system.threads import in_threads, most_threads


@dataclass(frozen=True, eq=False)
class Members:
    """n members of groups, in the numbers that regrouping needs."""

    means: Tensor  # [n, 3] float64, scene units
    cov: Tensor  # [n, 6] float64, squared scene units
    masses: Tensor  # [n] float64, opacity times root mean square area
    colours: Tensor  # [n, 3] float32 of SH degree 0, colour units

    @classmethod
    def of(cls, scene: Gaussians, rows: Tensor, settings: MergeSettings = MERGING) -> Members:
        """The Gaussians ``rows`` (n,) of a scene on the CPU."""
        cov = in_pieces(lambda these: covariances_of(scene, these), rows, 6)

        def masses(these: Tensor) -> Tensor:
            return torch.sigmoid(scene.opacities[rows[these], 0].double()) * rms_area(cov[these])

        return cls(
            scene.means[rows].double(),
            cov,
            in_pieces(masses, torch.arange(len(rows))),
            bounded_colours(scene.features_dc[rows], settings),
        )

    def __len__(self) -> int:
        return len(self.means)


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of K groups of n members, weighted by mass."""

    mass: Tensor  # [K] float64
    means: Tensor  # [K, 3] float64
    cov: Tensor  # [K, 6] float64, mean covariance of the members, and covariance of their means
    colours: Tensor  # [K, 3] float64, of SH degree 0
    shares: Tensor  # [n] float64, of the members in the mass of their groups


def regrouped(participants: Participants, groups: Groups, settings: MergeSettings) -> Groups:
    """Groups whose members fit them better.

    The mass of a group may differ from the sum of its members' masses, because members overlap. The ratio of both is
    kept.

    Args:
        participants: n Gaussians.
        groups: K groups of them.
        settings: ``regrouping_rounds`` and how members choose.
    """
    members = Members.of(participants.scene, participants.members, settings)
    group, count = groups.group, len(groups)
    common = group_moments(members, group, count)
    ratios = groups.alphas * rms_area(groups.cov) / common.mass.clamp_min(MIN_DIVISOR)
    for _ in range(settings.regrouping_rounds):
        group = best_groups(members, group, common, settings)
        common = group_moments(members, group, count)
    alphas = torch.where(
        common.mass > MIN_DIVISOR,
        ratios * common.mass / rms_area(common.cov).clamp_min(MIN_DIVISOR),
        groups.alphas,
    )
    return Groups(
        group,
        common.shares.float(),
        first_members(participants, group, count),
        common.means,
        enlarged(common.cov, alphas, settings),
        alphas.clamp_max(settings.max_opacity),
        torch.bincount(group, minlength=count).to(torch.int32),
    )


def group_moments(members: Members, group: Tensor, count: int) -> Moments:
    """Moments of groups.

    Args:
        members: n members.
        group: (n,) the group of each.
        count: number of groups, K; each has a member.
    """
    pieces = torch.arange(len(members)).split(CHUNK)

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(count, *shape, dtype=torch.float64)

    mass, sizes = zeros().index_add_(0, group, members.masses), torch.bincount(group, minlength=count)
    shares = torch.empty_like(members.masses)
    means, colours, cov = zeros(3), zeros(3), zeros(6)
    for rows in pieces:
        own = group[rows]
        total, masses = mass[own], members.masses[rows]
        shares[rows] = torch.where(total > MIN_DIVISOR, masses / total.clamp_min(MIN_DIVISOR), 1 / sizes[own])
        share = shares[rows, None]
        means.index_add_(0, own, share * members.means[rows])
        colours.index_add_(0, own, share * members.colours[rows])
    for rows in pieces:
        apart = members.means[rows] - means[group[rows]]
        cov.index_add_(0, group[rows], shares[rows, None] * (members.cov[rows] + outer(apart)))
    return Moments(mass, means, cov, colours, shares)


def best_groups(
    members: Members,
    group: Tensor,
    groups: Moments,
    settings: MergeSettings = MERGING,
    compiled: bool | None = None,
) -> Tensor:
    """The group (n,) that each member fits best, of its own and the nearest. The heaviest member of each group stays,
    so that no group is empty.

    Args:
        members: n members.
        group: (n,) the group of each.
        groups: moments of the groups.
        settings: ``regrouping_candidates`` and ``regrouping_contrast``.
        compiled: False leaves it to scipy and torch; True warns if the kernels could not be compiled.
    """
    count = len(groups.mass)
    variance = (groups.cov[:, (0, 3, 5)].mean(1)).clamp_min(MIN_DIVISOR)
    shapes = unpack(groups.cov / variance[:, None]) + 1e-6 * torch.eye(3, dtype=torch.float64)  # invertible if flat
    inverse = torch.linalg.inv(shapes)
    occurrences = inverse.new_tensor([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])  # of the six numbers of a symmetric matrix
    inverse = inverse[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)] * (occurrences / variance[:, None])
    log_determinants = torch.logdet(shapes) + 3 * variance.log()
    fits = Fits(groups.means, inverse, log_determinants, groups.colours, 1 / (2 * settings.regrouping_contrast**2))
    near = nearest_of(groups.means, members.means, group, settings.regrouping_candidates, compiled)
    if KERNELS.usable(compiled):
        result = _by_kernels(members, group, near, fits)
    else:
        result = torch.empty_like(group)

        def choose(rows: Tensor) -> None:
            result[rows] = fits.best_of(members, rows, torch.cat([group[rows, None], near[rows].long()], dim=1))

        in_threads(choose, torch.arange(len(members)).split(CHUNK // 4))  # each is compared with several groups
    heaviest = torch.zeros(count, dtype=torch.float64).scatter_reduce_(0, group, members.masses, "amax")
    return torch.where(members.masses >= heaviest[group], group, result)


@dataclass(frozen=True, eq=False)
class Fits:
    """Groups that members may fit."""

    means: Tensor  # [K, 3] float64
    inverse: Tensor  # [K, 6] float64 covariances, inverted, the numbers beside the diagonal twice
    log_determinants: Tensor  # [K] float64
    colours: Tensor  # [K, 3] float64
    colour_weight: float
    """Weight of the squared difference of colours."""

    def best_of(self, members: Members, rows: Tensor, candidates: Tensor) -> Tensor:
        """The candidate that each member of ``rows`` (m,) fits best, groups (m, c) int64; the first of equals."""
        apart = members.means[rows, None] - self.means[candidates]
        second = members.cov[rows, None] + outer(apart.view(-1, 3)).view(*candidates.shape, 6)
        fit = 0.5 * ((second * self.inverse[candidates]).sum(2) + self.log_determinants[candidates])
        contrast = members.colours[rows, None] - self.colours[candidates]
        fit += contrast.square().sum(2) * self.colour_weight
        best = fit.nan_to_num_(nan=torch.inf).argmin(1, keepdim=True)
        return candidates.gather(1, best)[:, 0]


def _by_kernels(members: Members, group: Tensor, near: Tensor, fits: Fits) -> Tensor:
    """As :meth:`Fits.best_of` for all members, each with its own group (n,) and the nearest (n, k) int32."""
    best = torch.empty_like(group)
    task = KERNELS.structs["Choice"](
        means=members.means, cov=members.cov, colours=members.colours, group=group, near=near, count=len(group),
        candidates=near.shape[1], group_means=fits.means, inverse=fits.inverse.contiguous(),
        log_determinants=fits.log_determinants, group_colours=fits.colours, colour_weight=fits.colour_weight, best=best,
    )  # fmt: skip
    on_threads(len(group) >= SEVERAL, KERNELS.library.pointsplat_best_groups, task, threads=most_threads())
    return best


def _as_torch() -> bool:
    """Whether the kernel chooses the groups of some members as torch does."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    members = Members(random(90, 3), random(90, 6), random(90), random(90, 3).float())
    fits = Fits(random(9, 3), random(9, 6), random(9), random(9, 3), 2.0)
    group, near = (torch.randint(9, shape, generator=generator) for shape in ((90,), (90, 4)))
    torchs = fits.best_of(members, torch.arange(90), torch.cat([group[:, None], near], dim=1))
    return torch.equal(_by_kernels(members, group, near.int(), fits), torchs)


KERNELS = Kernels("merging", Path(__file__).with_name("regrouping.cpp"), _as_torch)
