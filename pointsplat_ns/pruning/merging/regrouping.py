"""Regroups members: each member moves to the nearby group that fits it best.

Pairs are merged bottom-up and never separated. So some members end in a group whose other members
are elsewhere. As in k-means, each member then moves to the group that fits it best, and the groups
are recomputed: hard EM of a mixture of Gaussians whose data are Gaussians (Vasconcelos and Lippman,
Learning mixture hierarchies, NIPS 1998). A member with mean mu, covariance S and colour c fits a
group with mu_g, S_g and c_g by

    fit = 1/2 (tr(S_g^-1 (S + (mu - mu_g)(mu - mu_g)^T)) + log det S_g)
          + |c - c_g|^2 / (2 contrast^2)

Lower is better: the expected negative log-density of the group over the member, plus the colour
difference. A member's mass, the weight in the moments of its group, is opacity times root mean
square area.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.geometry.neighbours import NearestOf
from pointsplat_ns.pruning.merging.covariance import (
    MIN_DIVISOR,
    diagonals,
    inverses_and_log_determinants,
    outer,
    pack,
    rms_area,
    unpack,
)
from pointsplat_ns.pruning.merging.groups import Groups
from pointsplat_ns.pruning.merging.pairs import growth
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings
from pointsplat_ns.pruning.merging.state import Participants, bounded_colours
from pointsplat_ns.system.kernels import (
    DOUBLE_POINTER,
    FLOAT_POINTER,
    INT32_POINTER,
    INT64_POINTER,
    KERNELS,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.pieces import in_pieces, pieces
from pointsplat_ns.system.tensors import DOUBLES, add_rows, numbers
from pointsplat_ns.system.threads import parallel_for, parallel_map


class ChoiceStruct(Struct):
    """``Choice`` of ``covariance.cpp``, which documents its members."""

    members = {
        "means": DOUBLE_POINTER,
        "cov": DOUBLE_POINTER,
        "colours": FLOAT_POINTER,
        "group": INT64_POINTER,
        "near": INT32_POINTER,
        "count": ctypes.c_int64,
        "candidates": ctypes.c_int64,
        "group_means": DOUBLE_POINTER,
        "inverse": DOUBLE_POINTER,
        "log_determinants": DOUBLE_POINTER,
        "group_colours": DOUBLE_POINTER,
        "colour_weight": ctypes.c_double,
        "best": INT64_POINTER,
    }
    _fields_ = c_fields(members)


best_groups_kernel = Function("pointsplat_best_groups", ChoiceStruct, INT64_POINTER)


class Members:
    """The participants as members of groups. Only masses are stored; other properties are
    recomputed in pieces each time, which saves memory and, with the kernel, takes little time."""

    def __init__(self, participants: Participants):
        self._participants = participants
        self._scene = participants.scene
        self._rows = participants.members
        self.masses = in_pieces(
            lambda these: (
                torch.sigmoid(self._scene.opacities[self._rows[these], 0].double())
                * rms_area(participants.cov(these))
            ),
            numbers(len(participants), self._rows.device),
        )
        """Opacity times root mean square area, (n,)."""

    def pieces(self) -> list[slice]:
        """Slices of all members."""
        return pieces(len(self._rows), self._rows.device)

    def means(self, these: slice) -> Tensor:
        """Means (m, 3) float64 of a piece, scene units."""
        return self._scene.means[self._rows[these]].double()

    def cov(self, these: slice) -> Tensor:
        """Covariances (m, 6) float64 of a piece, with blur, squared scene units."""
        return self._participants.cov(these)

    def colours(self, these: slice) -> Tensor:
        """Colours (m, 3) float32 of SH degree 0 of a piece, colour units."""
        return bounded_colours(self._scene.features_dc[self._rows[these]])


@dataclass(frozen=True, eq=False)
class Moments:
    """Moments of K groups, weighted by mass."""

    mass: Tensor  # [K] float64
    sizes: Tensor  # [K] int64, number of members
    means: Tensor  # [K, 3] float64
    cov: Tensor  # [K, 6] float64, mean covariance of the members plus covariance of their means
    colours: Tensor  # [K, 3] float64, of SH degree 0

    def shares(self, masses: Tensor, group: Tensor) -> Tensor:
        """Shares (m,) float64 of members with masses (m,) in the mass of their groups (m,)."""
        total = self.mass[group]
        return torch.where(
            total > MIN_DIVISOR,
            masses / total.clamp_min(MIN_DIVISOR),
            1 / self.sizes[group].to(masses.dtype),
        )


def regrouped(participants: Participants, groups: Groups, settings: MergeSettings) -> Groups:
    """Groups with better fitting members.

    The mass of a group may differ from the sum of its members' masses, because members overlap.
    Regrouping preserves the ratio of the two.

    Args:
        participants: n Gaussians.
        groups: their groups; membership, sizes and opacities are used.
        settings: ``regrouping_rounds``, and the parameters of the fit.
    """
    group = groups.group
    alphas = groups.alphas
    areas = areas_of(groups.cov)
    del groups
    members = Members(participants)
    count = len(alphas)
    common = group_moments(members, group, count)
    ratios = alphas * areas / common.mass.clamp_min(MIN_DIVISOR)
    for _ in range(settings.regrouping_rounds):
        group = best_groups(members, group, common, settings)
        del common
        common = group_moments(members, group, count)
    alphas = torch.where(
        common.mass > MIN_DIVISOR,
        ratios * common.mass / areas_of(common.cov).clamp_min(MIN_DIVISOR),
        alphas,
    )
    shares = in_pieces(
        lambda these: common.shares(members.masses[these], group[these]),
        numbers(len(group), group.device),
        dtype=torch.float32,
    )
    return Groups(
        group=group,
        shares=shares,
        means=common.means,
        cov=common.cov * growth(alphas, settings)[:, None],
        alphas=alphas.clamp_max(settings.max_opacity),
        counts=common.sizes.to(torch.int32),
    )


def areas_of(cov: Tensor) -> Tensor:
    """Root mean square areas (K,) of covariances (K, 6), computed in pieces."""
    return in_pieces(lambda these: rms_area(cov[these]), numbers(len(cov), cov.device))


def group_moments(members: Members, group: Tensor, count: int) -> Moments:
    """Moments of groups.

    Args:
        members: n members.
        group: (n,) the group of each.
        count: number of groups, K; none is empty.
    """

    def zeros(*shape: int) -> Tensor:
        return members.masses.new_zeros(count, *shape)

    mass = add_rows(zeros(), group, members.masses)
    sizes = torch.bincount(group, minlength=count)
    found = Moments(mass, sizes, zeros(3), zeros(6), zeros(3))
    spread = (
        found.cov,
        lambda these: members.cov(these) + outer(members.means(these) - found.means[group[these]]),
    )
    for total, values_of in (
        (found.means, members.means),
        (found.colours, members.colours),
        spread,
    ):

        def shared(
            these: slice, values_of: Callable[[slice], Tensor] = values_of
        ) -> tuple[Tensor, Tensor]:
            return group[these], found.shares(members.masses[these], group[these])[
                :, None
            ] * values_of(these)

        for own, values in parallel_map(shared, members.pieces(), group.device):
            add_rows(total, own, values)
    return found


def best_groups(
    members: Members,
    group: Tensor,
    groups: Moments,
    settings: MergeSettings = MERGING,
    compiled: bool | None = None,
) -> Tensor:
    """The group (n,) that fits each member best, of its own and the six nearest. The heaviest
    member of each group stays, so that no group becomes empty.

    Args:
        members: n members.
        group: (n,) the group of each.
        groups: moments of the groups.
        settings: ``regrouping_contrast``.
        compiled: False uses torch; True warns if the kernels are missing.
    """
    inverse = torch.empty_like(groups.cov)
    log_determinants = torch.empty_like(groups.mass)
    # of the six numbers of a symmetric matrix
    occurrences = groups.cov.new_tensor([1.0, 2.0, 2.0, 1.0, 2.0, 1.0])

    def invert(some: slice) -> None:
        cov = groups.cov[some]
        variance = diagonals(cov).mean(1).clamp_min(MIN_DIVISOR)
        # invertible even if flat
        shapes = unpack(cov / variance[:, None]) + 1e-6 * torch.eye(3, **DOUBLES).to(cov.device)
        inverses, logs = inverses_and_log_determinants(shapes)
        inverse[some] = pack(inverses) * (occurrences / variance[:, None])
        log_determinants[some] = logs + 3 * variance.log()

    parallel_for(invert, pieces(len(groups.mass), group.device), group.device)
    colour_weight = 1 / (2 * settings.regrouping_contrast**2)

    result = torch.empty_like(group)
    nearest = NearestOf(groups.means, 6)

    def choose(these: slice) -> None:
        means = members.means(these)
        cov = members.cov(these)
        colours = members.colours(these)
        own = group[these]
        near = nearest(means)
        if KERNELS.usable_for(compiled, colours):
            best = torch.empty_like(own)
            task = ChoiceStruct(
                means=means,
                cov=cov,
                colours=colours,
                group=own,
                near=near.int(),
                count=len(own),
                candidates=near.shape[1],
                group_means=groups.means,
                inverse=inverse,
                best=best,
                log_determinants=log_determinants,
                group_colours=groups.colours,
                colour_weight=colour_weight,
            )
            on_threads(len(own) >= SEVERAL, best_groups_kernel, task)
            result[these] = best
            return
        candidates = torch.cat([own[:, None], near], dim=1)  # (m, 7)
        apart = means[:, None] - groups.means[candidates]
        second = cov[:, None] + outer(apart.view(-1, 3)).view(*candidates.shape, 6)
        fit = 0.5 * ((second * inverse[candidates]).sum(2) + log_determinants[candidates])
        fit += (colours[:, None] - groups.colours[candidates]).square().sum(2) * colour_weight
        best = fit.nan_to_num_(nan=torch.inf).argmin(1, keepdim=True)  # the first of equals
        result[these] = candidates.gather(1, best)[:, 0]

    parallel_for(choose, members.pieces(), group.device)
    heaviest = torch.zeros_like(groups.mass).scatter_reduce_(0, group, members.masses, "amax")
    return torch.where(members.masses >= heaviest[group], group, result)
