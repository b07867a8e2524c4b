"""Groups of merged Gaussians, and which group each member fits best.

Pairs are merged from the bottom up, and what is one stays one. So some members end in a group that has grown away from
them. As in k-means, each then goes to the group near it that it fits best, and the groups are made anew: hard EM of a
mixture of Gaussians whose data are Gaussians (Vasconcelos and Lippman, Learning mixture hierarchies, NIPS 1998).
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.pruning.covariance import TINY, outer, shadow, unpack
from pointsplat_ns.pruning.merge_state import MOST_CONTRAST, covariances_of
from pointsplat_ns.system.pieces import CHUNK, in_pieces
from pointsplat_ns.system.threads import in_threads

ROUNDS = 2
"""How often members change groups; in a third round about 3 % do."""

CANDIDATES = 6
"""Number of nearest groups that a member may go to."""

ROUNDNESS = 0.02
"""Added to a group's covariance, as a share of its mean variance: a flat one takes what lies a little beside it."""

CONTRAST = 0.3
"""Difference of colour, of all channels together in [0, 1], that counts as one standard deviation."""

_TWICE = torch.tensor([1.0, 2.0, 2.0, 1.0, 2.0, 1.0], dtype=torch.float64)
"""How often each of the six numbers of a symmetric matrix is in it."""


@dataclass(frozen=True, eq=False)
class Moments:
    """What groups have in common, by mass: opacity times the area of the projection."""

    mass: Tensor  # [K] float64
    means: Tensor  # [K, 3] float64
    cov: Tensor  # [K, 6] float64, of the members and between them
    colours: Tensor  # [K, 3] float64, constant part
    shares: Tensor  # [n] float64, of the members in their groups


def masses_of(scene: Gaussians, members: Tensor) -> Tensor:
    """Masses of some Gaussians (n,), float64."""
    return in_pieces(
        lambda rows: torch.sigmoid(scene.opacities[rows, 0].double()) * shadow(covariances_of(scene, rows)), members
    )


def moments(scene: Gaussians, members: Tensor, masses: Tensor, place: Tensor, count: int) -> Moments:
    """Moments of groups.

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) indices of those that belong to groups.
        masses: (n,) of them, see :func:`masses_of`.
        place: (n,) the group of each.
        count: number of groups, K; each has a member.
    """
    everywhere = torch.arange(len(members)).split(CHUNK)

    def summed(*shape: int) -> Tensor:
        return torch.zeros(count, *shape, dtype=torch.float64)

    mass, sizes = summed().index_add_(0, place, masses), torch.bincount(place, minlength=count)
    shares = torch.empty_like(masses)
    means, colours, cov = summed(3), summed(3), summed(6)
    for these in everywhere:
        group = place[these]
        whole = mass[group]
        shares[these] = torch.where(whole > TINY, masses[these] / whole.clamp_min(TINY), 1 / sizes[group])
        share = shares[these, None]
        means.index_add_(0, group, share * scene.means[members[these]].double())
        colours.index_add_(0, group, share * _colours(scene, members[these]))
    for these in everywhere:
        apart = scene.means[members[these]].double() - means[place[these]]
        cov.index_add_(0, place[these], shares[these, None] * (covariances_of(scene, members[these]) + outer(apart)))
    return Moments(mass, means, cov, colours, shares)


def regrouped(scene: Gaussians, members: Tensor, masses: Tensor, place: Tensor, groups: Moments) -> Tensor:
    """The group (n,) that each member fits best: of least expected -log of the group's density over the member, and
    least difference of colour. The heaviest member of each group stays, so that no group is empty.

    Args:
        scene, members, masses, place: as for :func:`moments`.
        groups: their moments.
    """
    from scipy.spatial import cKDTree

    count = len(groups.mass)
    spread = (groups.cov[:, (0, 3, 5)].mean(1)).clamp_min(TINY)
    shapes = unpack(groups.cov / spread[:, None]) + ROUNDNESS * torch.eye(3, dtype=torch.float64)
    inverse = torch.linalg.inv(shapes)
    inverse = inverse[:, (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)] * (_TWICE / spread[:, None])
    log_volumes = torch.logdet(shapes) + 3 * spread.log()
    tree = cKDTree(groups.means.numpy(), balanced_tree=False)
    ranks = list(range(1, min(CANDIDATES, count) + 1))
    result = place.clone()

    def choose(these: Tensor) -> None:
        own = members[these]
        means = scene.means[own].double()
        _, near = tree.query(means.numpy(), k=ranks)
        groups_near = torch.cat([place[these, None], torch.from_numpy(near).long()], dim=1)
        apart = means[:, None] - groups.means[groups_near]
        both = covariances_of(scene, own)[:, None] + outer(apart.view(-1, 3)).view(*groups_near.shape, 6)
        fit = 0.5 * ((both * inverse[groups_near]).sum(2) + log_volumes[groups_near])
        contrast = _colours(scene, own)[:, None] - groups.colours[groups_near]
        fit += contrast.square().sum(2) / (2 * CONTRAST**2)
        best = fit.nan_to_num_(nan=torch.inf).argmin(1, keepdim=True)
        result[these] = groups_near.gather(1, best)[:, 0]

    pieces = torch.arange(len(members)).split(CHUNK // 4)
    in_threads(choose, pieces)
    heaviest = torch.zeros(count, dtype=torch.float64).scatter_reduce_(0, place, masses, "amax")
    for these in pieces:
        stays = masses[these] >= heaviest[place[these]]
        result[these] = torch.where(stays, place[these], result[these])
    return result


def _colours(scene: Gaussians, rows: Tensor) -> Tensor:
    return (scene.features_dc[rows].double() * SH_C0).clamp_(-MOST_CONTRAST, MOST_CONTRAST)
