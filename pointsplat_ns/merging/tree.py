"""Which Gaussians were merged into which, and in what shares."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import FLAGS, FLOATS, INDICES


@dataclass(frozen=True, eq=False)
class Tree:
    """The pairs of all rounds, over n Gaussians, of which K remain."""

    parents: Tensor  # [n] int32, the Gaussian that each was merged into, itself if it remains
    remaining: Tensor  # [K] int64, ascending indices of those that remain
    rounds: tuple[tuple[Tensor, Tensor, Tensor], ...] = ()
    """First and second members (int32) of the pairs of each round, and the share of the first in the mass (float32)."""

    @classmethod
    def of_single(cls, n: int) -> Tree:
        """The tree before the first round."""
        return cls(torch.arange(n, dtype=torch.int32, device="cpu"), torch.arange(n, **INDICES))

    def after_round(self, first: Tensor, second: Tensor, shares: Tensor) -> Tree:
        """The tree after another round.

        Args:
            first, second: (E,) each, indices of the members of its pairs among those that remain.
            shares: (E,) float32, of the first in the mass of each pair.
        """
        stays = torch.ones(len(self.remaining), **FLAGS)
        stays[second] = False
        i, j = (self.remaining[these].to(torch.int32) for these in (first, second))
        parents = self.parents.clone()
        parents[j.long()] = i
        return Tree(parents, self.remaining[stays], (*self.rounds, (i, j, shares)))

    def groups(self) -> Tensor:
        """The index among those that remain of the Gaussian that each is part of, (n,) int64."""
        roots = self.parents
        while not torch.equal(above := roots[roots.long()], roots):
            roots = above
        group = torch.empty(len(roots), **INDICES)
        group[self.remaining] = torch.arange(len(self.remaining), **INDICES)
        return group[roots.long()]

    def shares(self) -> Tensor:
        """Share of each in the mass of the Gaussian that it is part of, (n,) float32: the product of its shares in all
        rounds, from the last to the first."""
        shares = torch.ones(len(self.parents), **FLOATS)
        for first, second, share in reversed(self.rounds):
            i, j = first.long(), second.long()
            shares[j] = shares[i] * (1 - share)
            shares[i] *= share
        return shares
