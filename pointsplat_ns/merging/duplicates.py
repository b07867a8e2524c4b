"""Exact copies: Gaussians that equal others in every parameter, to the bit.

Broken files have thousands of them, such as rows of zeros. Copies of one kind look like one Gaussian, and become one
before a scene is merged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN
from pointsplat_ns.system.pieces import CHUNK
from pointsplat_ns.system.tensors import FLAGS, INDICES


@dataclass(frozen=True, eq=False)
class Reduced:
    """A scene without some of its copies."""

    scene: Gaussians
    members: Tensor  # [m] ascending indices in ``scene`` of the members that are left
    index: Tensor | None  # [N] index in ``scene`` of the Gaussian that each of the original became; None: its own


class Copies:
    """The copies among some Gaussians of a scene.

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) ascending indices of the Gaussians that are compared, without NaN.
    """

    def __init__(self, scene: Gaussians, members: Tensor):
        self.scene, self.members = scene, members
        self.first = _first_equal(scene, members)  # [n] index in ``members`` of the first that each equals
        self.distinct = int((self.first == torch.arange(len(members), **INDICES)).sum())
        """Number of different members."""

    def __len__(self) -> int:
        return len(self.members)

    def reduced(self, k: int) -> Reduced:
        """The scene with ``k`` of the members, at least :attr:`distinct` and at most n. Of each kind, the last copies
        are removed, and the first one is changed so that it looks like itself and the removed ones together."""
        n = len(self)
        if k == n:
            return Reduced(self.scene, self.members, None)
        index, rank = torch.arange(len(self.scene), **INDICES), _ranks(self.first)
        removed = torch.ones(n, **FLAGS)
        removed[rank.sort(stable=True).indices[:k]] = False
        counts = torch.bincount(self.first[removed], minlength=n) + 1
        changed = (counts > 1).nonzero()[:, 0]
        rows = self.members[changed]
        opacities, scales = self.scene.opacities.clone(), self.scene.scales.clone()
        alphas, growth = stacked(torch.sigmoid(opacities[rows, 0].double()), counts[changed])
        opacities[rows, 0] = torch.logit(alphas).to(opacities.dtype)
        scales[rows] = (scales[rows].double() + growth[:, None]).to(scales.dtype)
        kept = torch.ones(len(self.scene), **FLAGS)
        kept[self.members[removed]] = False
        index[self.members[removed]] = self.members[self.first[removed]]
        place = kept.cumsum(0) - 1
        scene = self.scene.replace(opacities=opacities, scales=scales)[kept]
        return Reduced(scene, place[self.members[~removed]], place[index])


def stacked(alphas: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and size of one Gaussian that looks like several equal ones at the same place.

    Copies of opacity a let the share (1 - a G)^n through, where G falls from 1 at the centre, and where a G is below
    :data:`ALPHA_MIN` they are not drawn. So the one is as opaque as all of them at the centre, and as much larger as it
    takes to cover as much: the integral of 1 - (1 - a G)^n over a plane, where the area element is proportional to
    dG / G.

    Args:
        alphas: (m,) float64 opacities in [0, 1].
        counts: (m,) numbers of copies.

    Returns:
        Opacities (m,) and numbers to add to log-scales (m,). Copies too faint to be drawn remain as they are.

    Example:
        >>> alphas, growth = stacked(torch.tensor([0.5], dtype=torch.float64), torch.tensor([2]))
        >>> [round(float(value), 3) for value in (alphas, growth)]
        [0.75, 0.075]
    """
    found, growth = alphas.clone(), torch.zeros_like(alphas)
    nodes, weights = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(16))  # 4 digits
    for these in (alphas > ALPHA_MIN).nonzero()[:, 0].split(CHUNK):
        a, n = alphas[these], counts[these].double()
        found[these] = (-torch.expm1(n * torch.log1p(-a))).clamp_max(ALPHA_MAX)
        span = torch.log(a / ALPHA_MIN)
        drawn = (ALPHA_MIN * (0.5 * span[:, None] * (1 + nodes)).exp()).clamp_max(1.0)
        area = 0.5 * span * (-torch.expm1(n[:, None] * torch.log1p(-drawn)) @ weights)
        growth[these] = 0.5 * torch.log(area / (found[these] - ALPHA_MIN))
    return found, growth


def _first_equal(scene: Gaussians, members: Tensor) -> Tensor:
    """Index in ``members`` (n,) of the first that each equals in every parameter, itself if there is none before.

    Members that share a hash of their positions are hashed over all parameters, and compared with the first member of
    the same hash. If two different members share that hash as well, copies of the second are not found.
    """
    n = len(members)
    first = torch.arange(n, **INDICES)
    some = _repeated(_hashes([scene.means], members))
    if len(some) == 0:
        return first
    parameters = [value.flatten(1) for value in scene.tensors()]
    hashes = _hashes(parameters, members[some])
    _, kind = hashes.unique(return_inverse=True)
    leader = torch.full((len(some),), n, **INDICES).scatter_reduce_(0, kind, some, "amin")[kind]  # index in members
    same = torch.ones(len(some), **FLAGS)
    for value in parameters:
        for these in torch.arange(len(some), **INDICES).split(CHUNK):
            same[these] &= (value[members[some[these]]] == value[members[leader[these]]]).all(1)
    first[some[same]] = leader[same]
    return first


def _hashes(columns: list[Tensor], rows: Tensor) -> Tensor:
    """Hashes (m,) int64 of rows (m,) of tensors (N, D): of their bits, modulo 2^64."""
    result = torch.zeros(len(rows), **INDICES)
    integers = {2: torch.int16, 4: torch.int32, 8: torch.int64}
    for values in columns:
        for column in values.view(integers[values.element_size()]).unbind(1):
            result = (result ^ (result >> 29)).add_(column[rows]).mul_(0x2545F4914F6CDD1D)  # xorshift*'s
    return result


def _repeated(keys: Tensor) -> Tensor:
    """Ascending indices of the keys (n,) that occur more than once."""
    ranked, order = keys.sort()
    same = ranked[1:] == ranked[:-1]
    twice = torch.zeros(len(keys), **FLAGS)
    twice[order[1:][same]] = True
    twice[order[:-1][same]] = True
    return twice.nonzero()[:, 0]


def _ranks(kind: Tensor) -> Tensor:
    """Number of earlier members of the same ``kind`` (n,), for each."""
    ranked, order = kind.sort(stable=True)
    starts = torch.searchsorted(ranked, ranked)
    ranks = torch.empty_like(kind)
    ranks[order] = torch.arange(len(kind), **INDICES) - starts
    return ranks
