"""How groups are regrouped: each member changes to the group near it that it fits best.

Pairs are merged from the bottom up and are never separated. So some members end in a group whose other members lie
elsewhere. As in k-means, each member then changes to the group that it fits best, and the groups are computed anew:
hard EM of a mixture of Gaussians whose data are Gaussians (Vasconcelos and Lippman, Learning mixture hierarchies, NIPS
1998). A member with mean mu, covariance S and colour c fits a group with mu_g, S_g and c_g by

    fit = 1/2 (tr(S_g^-1 (S + (mu - mu_g)(mu - mu_g)^T)) + log det S_g) + |c - c_g|^2 / (2 contrast^2)

The less, the better: the expected negative log-density of the group over the member, and the difference of colour. The
mass of a member, by which the moments of a group are weighted, is opacity times root mean square area.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.merging.covariance import MIN_DIVISOR, covariances_of, outer, rms_area, unpack
from pointsplat_ns.pruning.merging.groups import Groups, first_members
from pointsplat_ns.pruning.merging.participants import Participants
from pointsplat_ns.pruning.merging.replacement import enlarged
from pointsplat_ns.pruning.merging.settings import DEFAULTS, MergeSettings
from pointsplat_ns.pruning.merging.state import bounded_colours
from pointsplat_ns.system.pieces import CHUNK, in_pieces
from pointsplat_ns.system.threads import in_threads

MEMBERS_AT_ONCE = CHUNK // 4
"""Number of members that choose their groups at once: each is compared with several."""

_OCCURRENCES = torch.tensor([1.0, 2.0, 2.0, 1.0, 2.0, 1.0], dtype=torch.float64)
"""How often each of the six numbers of a symmetric matrix occurs in it."""


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
    scene, members, group, count = participants.scene, participants.members, groups.group, len(groups)
    masses = masses_of(scene, members)
    common = moments(scene, members, masses, group, count, settings)
    ratios = groups.alphas * rms_area(groups.cov) / common.mass.clamp_min(MIN_DIVISOR)
    for _ in range(settings.regrouping_rounds):
        group = best_groups(scene, members, masses, group, common, settings)
        common = moments(scene, members, masses, group, count, settings)
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


def masses_of(scene: Gaussians, members: Tensor) -> Tensor:
    """Opacity times root mean square area of some Gaussians, (n,) float64."""

    def masses(rows: Tensor) -> Tensor:
        return torch.sigmoid(scene.opacities[rows, 0].double()) * rms_area(covariances_of(scene, rows))

    return in_pieces(masses, members)


def moments(
    scene: Gaussians,
    members: Tensor,
    masses: Tensor,
    group: Tensor,
    count: int,
    settings: MergeSettings = DEFAULTS,
) -> Moments:
    """Moments of groups.

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) indices of those that belong to groups.
        masses: (n,) of them, see :func:`masses_of`.
        group: (n,) the group of each.
        count: number of groups, K; each has a member.
        settings: ``max_colour``.
    """
    pieces = torch.arange(len(members)).split(CHUNK)

    def zeros(*shape: int) -> Tensor:
        return torch.zeros(count, *shape, dtype=torch.float64)

    mass, sizes = zeros().index_add_(0, group, masses), torch.bincount(group, minlength=count)
    shares = torch.empty_like(masses)
    means, colours, cov = zeros(3), zeros(3), zeros(6)
    for rows in pieces:
        own = group[rows]
        total = mass[own]
        shares[rows] = torch.where(total > MIN_DIVISOR, masses[rows] / total.clamp_min(MIN_DIVISOR), 1 / sizes[own])
        share = shares[rows, None]
        means.index_add_(0, own, share * scene.means[members[rows]].double())
        colours.index_add_(0, own, share * bounded_colours(scene.features_dc[members[rows]], settings))
    for rows in pieces:
        apart = scene.means[members[rows]].double() - means[group[rows]]
        cov.index_add_(0, group[rows], shares[rows, None] * (covariances_of(scene, members[rows]) + outer(apart)))
    return Moments(mass, means, cov, colours, shares)


def best_groups(
    scene: Gaussians,
    members: Tensor,
    masses: Tensor,
    group: Tensor,
    groups: Moments,
    settings: MergeSettings = DEFAULTS,
) -> Tensor:
    """The group (n,) that each member fits best, of its own and the nearest. The heaviest member of each group stays,
    so that no group is empty.

    Args:
        scene, members, masses, group: as for :func:`moments`.
        groups: their moments.
        settings: ``regrouping_candidates``, ``regrouping_contrast`` and ``max_colour``.
    """
    from scipy.spatial import cKDTree

    count = len(groups.mass)
    variance = (groups.cov[:, (0, 3, 5)].mean(1)).clamp_min(MIN_DIVISOR)
    shapes = unpack(groups.cov / variance[:, None]) + 1e-6 * torch.eye(3, dtype=torch.float64)  # invertible if flat
    inverse = torch.linalg.inv(shapes)
    inverse = inverse[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)] * (_OCCURRENCES / variance[:, None])
    log_determinants = torch.logdet(shapes) + 3 * variance.log()
    tree = cKDTree(groups.means.numpy(), balanced_tree=False)
    ranks = list(range(1, min(settings.regrouping_candidates, count) + 1))
    result = group.clone()

    def choose(rows: Tensor) -> None:
        own = members[rows]
        means = scene.means[own].double()
        _, nearest = tree.query(means.numpy(), k=ranks)
        candidates = torch.cat([group[rows, None], torch.from_numpy(nearest).long()], dim=1)
        apart = means[:, None] - groups.means[candidates]
        second = covariances_of(scene, own)[:, None] + outer(apart.view(-1, 3)).view(*candidates.shape, 6)
        fit = 0.5 * ((second * inverse[candidates]).sum(2) + log_determinants[candidates])
        contrast = bounded_colours(scene.features_dc[own], settings)[:, None] - groups.colours[candidates]
        fit += contrast.square().sum(2) / (2 * settings.regrouping_contrast**2)
        best = fit.nan_to_num_(nan=torch.inf).argmin(1, keepdim=True)
        result[rows] = candidates.gather(1, best)[:, 0]

    pieces = torch.arange(len(members)).split(MEMBERS_AT_ONCE)
    in_threads(choose, pieces)
    heaviest = torch.zeros(count, dtype=torch.float64).scatter_reduce_(0, group, masses, "amax")
    for rows in pieces:
        stays = masses[rows] >= heaviest[group[rows]]
        result[rows] = torch.where(stays, group[rows], result[rows])
    return result
