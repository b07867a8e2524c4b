"""Groups: the participants that were merged into one Gaussian each, and that Gaussian."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.merging.participants import Participants
from pointsplat_ns.merging.state import State
from pointsplat_ns.merging.tree import Tree
from pointsplat_ns.system.tensors import INDICES


@dataclass(frozen=True, eq=False)
class Groups:
    """n participants in K groups."""

    group: Tensor  # [n] int64, the group of each participant
    shares: Tensor  # [n] float32, of each participant in the mass of its group
    first: Tensor  # [K] int64, index in the scene of the first member
    means: Tensor  # [K, 3] float64, scene units
    cov: Tensor  # [K, 6] float64, squared scene units
    alphas: Tensor  # [K] float64
    counts: Tensor  # [K] int32, number of members

    @classmethod
    def of(cls, state: State, group: Tensor, shares: Tensor, first: Tensor) -> Groups:
        """The groups that became the Gaussians of a state."""
        return cls(group, shares, first, *state.in_scene_units(), state.alphas.double(), state.counts)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def any_merged(self) -> bool:
        """Whether any group has more than one member."""
        return bool((self.counts > 1).any())

    def in_order(self) -> Groups:
        """The groups in the order of their first members."""
        order = self.first.argsort()
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order), **INDICES)
        ordered = (values[order] for values in (self.first, self.means, self.cov, self.alphas, self.counts))
        return Groups(rank[self.group], self.shares, *ordered)


def merged_groups(participants: Participants, state: State, tree: Tree) -> Groups:
    """The groups of the rounds so far, in the order of the state."""
    group = tree.groups()
    first = first_members(participants, group, len(state))
    return Groups.of(state, group, tree.shares(), first)


def first_members(participants: Participants, group: Tensor, count: int) -> Tensor:
    """Index in the scene of the first member of each of ``count`` groups, (K,) int64."""
    first = torch.full((count,), len(participants.scene), **INDICES)
    return first.scatter_reduce_(0, group, participants.members, "amin")
