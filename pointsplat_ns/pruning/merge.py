"""Merging: replaces a scene by fewer Gaussians that look the same, from the scene's 3D attributes alone.

Over a few rounds, pairs of neighbours are replaced by one Gaussian with their common mass (opacity times the area of
the projection), centre, covariance and colour. The cost of a pair is the expected change of rendered images, see
:mod:`~pointsplat_ns.pruning.pair_costs`.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.geometry.neighbours import nearest_and_walk
from pointsplat_ns.pruning.covariance import TINY, covariances, unpack
from pointsplat_ns.pruning.pair_costs import CHUNK, OPAQUE, Remaining, costs_of, moments_of, replacements_of
from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN

NEIGHBOURS = 8
"""Number of nearest centres that a Gaussian may be merged with."""

SHARE_PER_ROUND = 0.4
"""Share of the remaining Gaussians that may be merged away in one round. Smaller shares are greedier and measured
worse: the cost of a pair does not include earlier losses of its members, and even thinning keeps losses small."""

DEEPENING = 0.25
"""The optical depth of a merged Gaussian is multiplied by its number of members to this power. Merging keeps the mass
but spreads it over a larger area, so that more of the background shows through. The power was found by measurement."""

COLOUR_AXES = 8
"""Number of principal axes of the colours (all SH bands) used for costs; they hold nearly all of the variance."""


@dataclass(frozen=True, eq=False)
class Merged:
    """The result of merging."""

    scene: Gaussians
    """K Gaussians in the order of their first members. Those not merged with any other are unchanged to the bit."""
    assignment: Tensor  # [N] int64, index in ``scene`` of the Gaussian that each was merged into; -1 if dropped


def merge(scene: Gaussians, k: int, progress: Callable[[float], None] | None = None) -> Merged:
    """Replace a scene by ``k`` Gaussians that look the same.

    Gaussians too faint to be drawn are dropped first; the others are merged in pairs, cheapest first.

    Args:
        scene: N Gaussians. Those that are not :meth:`~pointsplat_ns.gaussians.Gaussians.usable` are dropped, unless
            ``k`` is N.
        k: number of Gaussians in the result; N returns the scene itself.
        progress: called with the share done, in [0, 1].

    Returns:
        Exactly ``k`` Gaussians. Deterministic.

    Raises:
        BudgetError: if ``k`` is not in 1..N, or fewer than ``k`` Gaussians can be drawn.
    """
    return next(merge_levels(scene, [k], progress))


def merge_levels(
    scene: Gaussians, counts: Sequence[int], progress: Callable[[float], None] | None = None
) -> Iterator[Merged]:
    """Replace a scene by fewer and fewer Gaussians in one pass.

    Each level is merged from the one before: Gaussians that are one in a level are one in all that follow.

    Args:
        scene: N Gaussians, see :func:`merge`.
        counts: number of Gaussians of each level, in 1..N, descending without repetition.
        progress: called with the share done of all levels, in [0, 1].

    Yields:
        A level for each count, as soon as it is reached.

    Raises:
        BudgetError: if a count is not in 1..N, the counts do not descend, or the first is more than can be drawn.
    """
    n = len(scene)
    for k in counts:
        if not 1 <= k <= n:
            raise BudgetError(f"cannot merge {n} Gaussians into {k}; expected 1 to {n}")
    if any(fewer >= more for more, fewer in itertools.pairwise(counts)):
        raise BudgetError(f"levels of {', '.join(map(str, counts))} Gaussians; expected descending counts")
    return _levels(scene, counts, progress or (lambda share: None))


@torch.no_grad()
def _levels(scene: Gaussians, counts: Sequence[int], report: Callable[[float], None]) -> Iterator[Merged]:
    n = len(scene)
    if n in counts:
        yield Merged(scene, torch.arange(n, device=scene.device))
        counts = counts[1:]
    if not counts:
        report(1.0)
        return
    members = _visible(scene, counts[0])
    part = scene[members].to(device="cpu")
    owner = torch.arange(len(part))  # [len(part)] index in part of the Gaussian that each is merged into
    state = _start(part)
    alive = owner.clone()  # [len(state)] index in part of each remaining Gaussian
    whole = max(len(part) - counts[-1], 1)
    for k in counts:
        while len(state) > k:
            first, second = _cheapest(state, k)
            _replace(state, first, second)
            owner[alive[second]] = alive[first]
            left = torch.ones(len(state), dtype=torch.bool)
            left[second] = False
            alive = alive[left]
            state.keep(left)
            report(1 - (len(state) - counts[-1]) / whole)
        while bool((owner[owner] != owner).any()):
            owner = owner[owner]
        place = torch.full((len(part),), -1)
        place[alive] = torch.arange(len(alive))
        assignment = torch.full((n,), -1, device=scene.device)
        assignment[members] = place[owner].to(scene.device)
        merged = _merged(state, part, alive, torch.bincount(place[owner], minlength=k))
        yield Merged(merged.to(scene.device), assignment)
    report(1.0)


def _merged(state: Remaining, part: Gaussians, alive: Tensor, sizes: Tensor) -> Gaussians:
    """The remaining Gaussians, of ``sizes`` (n,) members each, as a scene; those of one member as in ``part``, where
    they are ``alive`` (n,)."""
    deepened = dataclasses.replace(state, alphas=_deepened(state.alphas, sizes))
    replaced, kept = _as_gaussians(deepened, part), part[alive]
    pairs = zip(kept.tensors(), replaced.tensors(), strict=True)
    return Gaussians(*(torch.where((sizes == 1).view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in pairs))


def _visible(scene: Gaussians, k: int) -> Tensor:
    """Ascending indices of the visible Gaussians; if they are fewer than ``k``, also of the most opaque others."""
    usable = scene.usable()
    if int(usable.sum()) < k:
        raise BudgetError(f"cannot keep {k} Gaussians: {int(usable.sum())} of {len(scene)} have finite parameters")
    seen = usable & (scene.alphas >= ALPHA_MIN)
    short = k - int(seen.sum())
    if short > 0:
        order = torch.where(usable & ~seen, scene.opacities[:, 0], -math.inf).sort(descending=True, stable=True).indices
        candidates = order[(usable & ~seen)[order]]
        seen[candidates[:short]] = True
    return seen.nonzero()[:, 0]


def _start(scene: Gaussians) -> Remaining:
    sh = scene.sh.reshape(len(scene), -1)
    # By Parseval, the coefficients of every band contribute to the mean square over directions as the constant does.
    centred = sh.double() * SH_C0
    centred = centred - centred.mean(dim=0)
    axes = torch.linalg.eigh(centred.T @ centred).eigenvectors[:, -COLOUR_AXES:]
    return Remaining(
        means=scene.means.double(),
        cov=covariances(scene.scales.double(), scene.quats.double()),
        alphas=scene.alphas.double(),
        colours=centred @ axes,
        sh=sh.clone(),
    )


def _neighbours(means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Distinct pairs (i, j), i < j, of every centre with its nearest ones; and all centres (n,) in the order of the
    search tree's leaves."""
    n = len(means)
    _, near, walk = nearest_and_walk(means, NEIGHBOURS + 1)
    one, other = torch.arange(n).repeat_interleave(near.shape[1]), near.reshape(-1)
    key = torch.unique(torch.minimum(one, other) * n + torch.maximum(one, other))
    first, second = key // n, key % n
    apart = first != second
    return first[apart], second[apart], walk


def _cheapest(state: Remaining, k: int) -> tuple[Tensor, Tensor]:
    """Disjoint pairs to merge in this round."""
    n = len(state)
    first, second, walk = _neighbours(state.means)
    chosen, costs = _match(first, second, n, state)
    if len(chosen) < n / 10:  # many coincident centres have the same few nearest
        first, second = torch.cat([first, walk[:-1]]), torch.cat([second, walk[1:]])
        chosen, costs = _match(first, second, n, state)
    count = max(1, min(n - k, int(n * SHARE_PER_ROUND)))
    chosen = chosen[costs[chosen].sort(stable=True).indices[:count]]
    return first[chosen], second[chosen]


def _match(first: Tensor, second: Tensor, n: int, state: Remaining, passes: int = 6) -> tuple[Tensor, Tensor]:
    """Indices of disjoint pairs, and the costs of all pairs (E,). Each pass takes the pairs that are the cheapest for
    both of their members, among the Gaussians still free."""
    costs = costs_of(state, first, second)
    rank = torch.empty(len(costs), dtype=torch.long)
    rank[costs.sort(stable=True).indices] = torch.arange(len(costs))
    free = torch.ones(n, dtype=torch.bool)
    ids = torch.arange(len(costs))
    chosen = []
    for _ in range(passes):
        i, j, r = first[ids], second[ids], rank[ids]
        best = torch.full((n,), len(costs)).scatter_reduce_(0, i, r, "amin").scatter_reduce_(0, j, r, "amin")
        mutual = (best[i] == r) & (best[j] == r)
        chosen.append(ids[mutual])
        free[i[mutual]] = False
        free[j[mutual]] = False
        ids = ids[free[i] & free[j]]
        if len(ids) == 0:
            break
    return torch.cat(chosen), costs


def _replace(state: Remaining, first: Tensor, second: Tensor) -> None:
    """Overwrite the first member of each pair by the pair's replacement."""
    for i, j in zip(first.split(CHUNK), second.split(CHUNK), strict=True):
        pairs = replacements_of(state, i, j, moments_of(state, i, j))
        state.means[i], state.cov[i], state.alphas[i] = pairs.means, pairs.cov, pairs.alphas
        for values in (state.colours, state.sh):
            weight = pairs.weight[:, None].to(values.dtype)
            values[i] = weight * values[i] + (1 - weight) * values[j]


def _deepened(alphas: Tensor, sizes: Tensor) -> Tensor:
    """Opacities (n,) of Gaussians with ``sizes`` (n,) members: 1 - (1 - alpha)^p, where p = sizes^:data:`DEEPENING`."""
    depth = -torch.log1p(-alphas.clamp_max(OPAQUE)) * sizes.double() ** DEEPENING
    return (-torch.expm1(-depth)).clamp_max(ALPHA_MAX)


def _as_gaussians(state: Remaining, like: Gaussians) -> Gaussians:
    """The state as a scene, in the dtype of ``like``."""
    from scipy.spatial.transform import Rotation

    variances, axes = torch.linalg.eigh(unpack(state.cov))
    axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]
    quats = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat())[:, [3, 0, 1, 2]]
    sh = state.sh.view(len(state), -1, 3)
    scene = Gaussians(
        means=state.means,
        scales=0.5 * variances.clamp_min(TINY).log(),
        quats=quats,
        opacities=torch.logit(state.alphas, 1e-7)[:, None],
        features_dc=sh[:, 0].double(),
        features_rest=sh[:, 1:].double(),
    )
    return scene.to(like.dtype)
