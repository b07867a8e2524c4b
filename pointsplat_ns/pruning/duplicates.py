"""Exact copies: Gaussians that equal others in every parameter, to the bit.

Broken files have thousands of them, such as rows of zeros. They look like one Gaussian, and become one before a scene
is merged.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN

CHUNK = 1 << 16
"""Number of Gaussians processed at once where many numbers of each are needed."""

NODES = 16
"""Of the quadrature in :func:`stacked`: enough for 4 digits."""

_INTEGERS = {2: torch.int16, 4: torch.int32, 8: torch.int64}
_FACTOR = 0x2545F4914F6CDD1D
"""Odd; of the generator xorshift* (Vigna 2016, ACM TOMS 42(4))."""


@dataclass(frozen=True, eq=False)
class Reduced:
    """A scene without some of its copies."""

    scene: Gaussians
    members: Tensor  # [m] ascending indices in ``scene`` of those that take part
    index: Tensor  # [N] index in ``scene`` of what each Gaussian of the original became


class Copies:
    """The copies among some Gaussians of a scene.

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) ascending indices of those that are compared; nothing of them is NaN.
    """

    def __init__(self, scene: Gaussians, members: Tensor):
        self.scene, self.members = scene, members
        self.first = _first_equal(scene, members)  # [n] index in ``members`` of the first that each equals
        self.distinct = int((self.first == torch.arange(len(members))).sum())
        """Number of members that differ."""

    def __len__(self) -> int:
        return len(self.members)

    def reduced(self, k: int) -> Reduced:
        """The scene with ``k`` of the members, at least :attr:`distinct` and at most n. Second copies go last; of each
        kind, those that go become one with the first, which then looks like all of them."""
        n = len(self)
        everyone = torch.arange(len(self.scene))
        if k == n:
            return Reduced(self.scene, self.members, everyone)
        rank = _ranks(self.first)
        gone = torch.ones(n, dtype=torch.bool)
        gone[rank.sort(stable=True).indices[:k]] = False
        counts = torch.bincount(self.first[gone], minlength=n) + 1
        grown = (counts > 1).nonzero()[:, 0]
        rows = self.members[grown]
        opacities, scales = self.scene.opacities.clone(), self.scene.scales.clone()
        alphas, growth = stacked(torch.sigmoid(opacities[rows, 0].double()), counts[grown])
        opacities[rows, 0] = torch.logit(alphas).to(opacities.dtype)
        scales[rows] = (scales[rows].double() + growth[:, None]).to(scales.dtype)
        stays = torch.ones(len(self.scene), dtype=torch.bool)
        stays[self.members[gone]] = False
        everyone[self.members[gone]] = self.members[self.first[gone]]
        place = stays.cumsum(0) - 1
        scene = self.scene.replace(opacities=opacities, scales=scales)[stays]
        return Reduced(scene, place[self.members[~gone]], place[everyone])


def stacked(alphas: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """What one Gaussian must be to look like several equal ones at the same place.

    Copies of opacity a let the share (1 - a G)^n through, where G falls from 1 at the centre, and where a G is below
    :data:`ALPHA_MIN` they are not drawn. So the one is as opaque as all of them at the centre, and as much larger as it
    takes to cover as much: the integral of 1 - (1 - a G)^n over a plane, where the area element is proportional to
    dG / G. That is smaller for copies that are hardly drawn themselves.

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
    nodes, weights = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(NODES))
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

    Those that share a hash of their positions are hashed whole, and compared with the first of the same hash. Two that
    differ and share that as well hide copies of the second; nothing else can go wrong.
    """
    n = len(members)
    first = torch.arange(n)
    some = _repeated(_hashes([scene.means], members))
    if len(some) == 0:
        return first
    parameters = [value.flatten(1) for value in scene.tensors()]
    hashes = _hashes(parameters, members[some])
    _, kind = hashes.unique(return_inverse=True)
    leader = torch.full((len(some),), n).scatter_reduce_(0, kind, some, "amin")[kind]  # [len(some)] index in members
    same = torch.ones(len(some), dtype=torch.bool)
    for value in parameters:
        for these in torch.arange(len(some)).split(CHUNK):
            same[these] &= (value[members[some[these]]] == value[members[leader[these]]]).all(1)
    first[some[same]] = leader[same]
    return first


def _hashes(columns: list[Tensor], rows: Tensor) -> Tensor:
    """Hashes (m,) int64 of rows (m,) of tensors (N, D): of their bits, modulo 2^64."""
    result = torch.zeros(len(rows), dtype=torch.int64)
    for values in columns:
        for column in values.view(_INTEGERS[values.element_size()]).unbind(1):
            result = (result ^ (result >> 29)).add_(column[rows]).mul_(_FACTOR)
    return result


def _repeated(keys: Tensor) -> Tensor:
    """Ascending indices of the keys (n,) that occur more than once."""
    ranked, order = keys.sort()
    same = ranked[1:] == ranked[:-1]
    twice = torch.zeros(len(keys), dtype=torch.bool)
    twice[order[1:][same]] = True
    twice[order[:-1][same]] = True
    return twice.nonzero()[:, 0]


def _ranks(kind: Tensor) -> Tensor:
    """How many before each have the same ``kind`` (n,)."""
    ranked, order = kind.sort(stable=True)
    starts = torch.searchsorted(ranked, ranked)
    ranks = torch.empty_like(kind)
    ranks[order] = torch.arange(len(kind)) - starts
    return ranks
