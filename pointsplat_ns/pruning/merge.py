"""Merging: fewer Gaussians that look the same, from the 3D attributes of the scene alone.

Neighbours are replaced in pairs, over a few rounds, by one Gaussian with their common mass (opacity times
area of the shadow), centre, covariance and colour. What a pair costs is the change of the picture that it is
expected to make. Near a surface the picture is a blend, sum(a G c) / sum(a G), so a change of one Gaussian
shows in proportion to its contrast with what surrounds it and in inverse proportion to how much else covers
the same place; where little does, the unknown background shows too.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.geometry.neighbours import nearest_and_walk
from pointsplat_ns.pruning.covariance import (
    TINY,
    covariances,
    flat_area,
    flatten,
    normals,
    outer,
    overlap,
    plane,
    shadow,
    unpack,
)

NEIGHBOURS = 8
"""Nearest centres that a Gaussian may be merged with."""

SHARE_PER_ROUND = 0.4
"""Of the Gaussians left, how many may vanish in one round. Fewer is greedier and measured worse: the cost of
a pair does not know what its members had already lost, and even thinning keeps losses small everywhere."""

INVISIBLE = 1 / 255
"""Opacity below which rasterizers draw nothing."""

OPAQUE = 0.99
"""Largest opacity that a merge gives; what mass is left over becomes area."""

MOST_DRAWN = 0.999
"""Largest opacity of a finished Gaussian; rasterizers draw no more."""

GROWTH = 0.6
"""Power of the mass beyond :data:`OPAQUE` by which the area grows: 0 would open holes, 1 smears edges."""

DEEPENING = 0.25
"""Power of the number of members by which the optical depth of a finished Gaussian grows. The mass of pairs is kept,
but each merge spreads it further, and the more were merged, the more shows through. The power is measured."""

MOST_SURPLUS = 4.0
"""Bound of that mass over what the area holds. Two Gaussians seldom reach 2; points without area would be infinite."""

LOCAL_CONTRAST = 0.01
"""Contrast assumed with the surroundings beside the one measured, colour units of [0, 1] a channel."""

BACKGROUND_CONTRAST = 0.3
"""Contrast assumed with whatever is far behind, which shows where few Gaussians overlap."""

COLOUR_AXES = 8
"""Principal axes of the colours (all SH bands) that costs are computed with: nearly all of their variance."""

FACE_ON, *SIDEWAYS = 0, 1, 2
"""Directions that pairs are judged from; depth between members shows from the side only."""

CHUNK = 1 << 17
"""Pairs worked on at once: about 100 MB."""


@dataclass(frozen=True, eq=False)
class Merged:
    """What a merging made."""

    scene: Gaussians
    """K Gaussians in the order of their first members. Those merged with nothing are bit for bit as they were."""
    assignment: Tensor  # [N] int64, the merged Gaussian that each of the dense scene is part of; -1 if dropped

    @property
    def sizes(self) -> Tensor:
        """How many Gaussians each of the merged stands for, (K,) int64."""
        return torch.bincount(self.assignment[self.assignment >= 0], minlength=len(self.scene))


@dataclass
class _State:
    """Gaussians at some round, float64 but for the SH."""

    means: Tensor  # [n, 3]
    cov: Tensor  # [n, 6]
    alphas: Tensor  # [n]
    colours: Tensor  # [n, C] on principal axes
    sh: Tensor  # [n, (d+1)^2 * 3]

    def __len__(self) -> int:
        return len(self.means)

    def keep(self, mask: Tensor) -> None:
        self.means, self.cov, self.alphas = self.means[mask], self.cov[mask], self.alphas[mask]
        self.colours, self.sh = self.colours[mask], self.sh[mask]


@dataclass
class _Joined:
    """Moments of pairs, whatever they are seen from."""

    weight: Tensor  # [E] share of i in the mass
    apart: Tensor  # [E, 3] from j to i
    means: Tensor  # [E, 3]
    cov: Tensor  # [E, 6]
    axes: tuple[Tensor, Tensor, Tensor]  # [E, 3] orthonormal, the last near the thinnest axis


@dataclass
class _Pairs:
    """Pairs (i, j) and the Gaussian that would replace each; shadows are seen along one direction."""

    means: Tensor  # [E, 3]
    cov: Tensor  # [E, 6]
    alphas: Tensor  # [E]
    weight: Tensor  # [E] share of i in the mass
    areas: tuple[Tensor, Tensor, Tensor]  # [E] shadows of i, j and the merged
    overlaps: tuple[Tensor, Tensor, Tensor]  # [E] of i with j, i with the merged, j with the merged


@torch.no_grad()
def merge(scene: Gaussians, k: int, progress: Callable[[float], None] | None = None) -> Merged:
    """Replace a scene by ``k`` Gaussians that look the same.

    Gaussians too faint to be drawn go first; the others are merged in pairs, cheapest first.

    Args:
        scene: N Gaussians. Those with NaN, or Inf where it has no meaning, are never part of the result.
        k: how many to make; N gives the scene itself.
        progress: called with the share done, in [0, 1].

    Returns:
        Exactly ``k`` Gaussians, the same ones for the same input.

    Raises:
        BudgetError: if ``k`` is not in 1..N, or is more than can be drawn.
    """
    n = len(scene)
    if not 1 <= k <= n:
        raise BudgetError(f"cannot merge {n} Gaussians into {k}; expected 1 to {n}")
    report = progress or (lambda share: None)
    if k == n:
        report(1.0)
        return Merged(scene, torch.arange(n, device=scene.device))
    members = _visible(scene, k)
    part = scene[members].to(device="cpu")
    owner = torch.arange(len(part))  # in part, of each of part's Gaussians: the one that it is merged into
    state = _start(part)
    alive = owner.clone()  # in part, of each of state's
    whole = max(len(part) - k, 1)
    while len(state) > k:
        first, second = _cheapest(state, k)
        _replace(state, first, second)
        owner[alive[second]] = alive[first]
        left = torch.ones(len(state), dtype=torch.bool)
        left[second] = False
        alive = alive[left]
        state.keep(left)
        report(1 - (len(state) - k) / whole)
    while bool((owner[owner] != owner).any()):
        owner = owner[owner]
    place = torch.full((len(part),), -1)
    place[alive] = torch.arange(len(alive))
    sizes = torch.bincount(place[owner], minlength=k)
    state.alphas = _deepened(state.alphas, sizes)
    made = _as_gaussians(state, part)
    kept = part[alive]
    pairs = zip(kept.tensors(), made.tensors(), strict=True)
    merged = Gaussians(*(torch.where((sizes == 1).view(-1, *[1] * (a.dim() - 1)), a, b) for a, b in pairs))
    assignment = torch.full((n,), -1, device=scene.device)
    assignment[members] = place[owner].to(scene.device)
    report(1.0)
    return Merged(merged.to(scene.device), assignment)


def _visible(scene: Gaussians, k: int) -> Tensor:
    """Indices, ascending, of what can be drawn; if that is fewer than ``k``, the most opaque others too."""
    usable = scene.usable()
    if int(usable.sum()) < k:
        raise BudgetError(f"cannot keep {k} Gaussians: {int(usable.sum())} of {len(scene)} have finite parameters")
    seen = usable & (scene.alphas >= INVISIBLE)
    short = k - int(seen.sum())
    if short > 0:
        order = torch.where(usable & ~seen, scene.opacities[:, 0], -math.inf).sort(descending=True, stable=True).indices
        candidates = order[(usable & ~seen)[order]]
        seen[candidates[:short]] = True
    return seen.nonzero()[:, 0]


def _start(scene: Gaussians) -> _State:
    sh = scene.sh.reshape(len(scene), -1)
    # Band l of the SH adds its squares to the mean square over directions as the constant band does (Parseval).
    centred = sh.double() * SH_C0
    centred = centred - centred.mean(dim=0)
    axes = torch.linalg.eigh(centred.T @ centred).eigenvectors[:, -COLOUR_AXES:]
    return _State(
        means=scene.means.double(),
        cov=covariances(scene.scales.double(), scene.quats.double()),
        alphas=scene.alphas.double(),
        colours=centred @ axes,
        sh=sh.clone(),
    )


def _neighbours(means: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pairs (i, j), i < j, each once, of every centre with its nearest; and a walk (n,) through all centres in the
    order of the tree's leaves."""
    n = len(means)
    _, near, walk = nearest_and_walk(means, NEIGHBOURS + 1)
    one, other = torch.arange(n).repeat_interleave(near.shape[1]), near.reshape(-1)
    key = torch.unique(torch.minimum(one, other) * n + torch.maximum(one, other))
    first, second = key // n, key % n
    apart = first != second
    return first[apart], second[apart], walk


def _join(state: _State, i: Tensor, j: Tensor) -> _Joined:
    """Moments of the mass of Gaussians ``i`` (E,) and ``j`` (E,) together."""
    mi, mj = (state.alphas[x] * shadow(state.cov[x]) for x in (i, j))
    total = mi + mj
    wi = torch.where(total > TINY, mi / total.clamp_min(TINY), 0.5)
    wj = 1 - wi
    apart = state.means[i] - state.means[j]
    means = wi[:, None] * state.means[i] + wj[:, None] * state.means[j]
    cov = wi[:, None] * state.cov[i] + wj[:, None] * state.cov[j] + (wi * wj)[:, None] * outer(apart)
    normal = normals(cov)
    return _Joined(wi, apart, means, cov, (*plane(normal), normal))


def _pair(state: _State, i: Tensor, j: Tensor, joined: _Joined, view: int = FACE_ON) -> _Pairs:
    """What would replace the pairs, seen along its thinnest axis or one of the two across it, with opacity such that
    the mass is that of both less what is covered twice."""
    ai, aj = state.alphas[i], state.alphas[j]
    wi, wj, apart, means, cov, axes = (
        joined.weight,
        1 - joined.weight,
        joined.apart,
        joined.means,
        joined.cov,
        joined.axes,
    )
    e1, e2 = axes[view], axes[(view + 1) % 3]
    si, sj, sk = (flatten(c, e1, e2) for c in (state.cov[i], state.cov[j], cov))
    u, v = (apart * e1).sum(1), (apart * e2).sum(1)
    pi, pj, pk = flat_area(si), flat_area(sj), flat_area(sk)
    oij = overlap(si, sj, u, v)
    alphas = (ai * pi + aj * pj - ai * aj * oij).clamp_min(0) / pk.clamp_min(TINY)
    growth = (alphas / OPAQUE).clamp(1, MOST_SURPLUS) ** GROWTH
    sk, pk, cov = sk * growth[:, None], pk * growth, cov * growth[:, None]
    oik, ojk = overlap(si, sk, wj * u, wj * v), overlap(sj, sk, wi * u, wi * v)
    return _Pairs(means, cov, alphas.clamp_max(OPAQUE), wi, (pi, pj, pk), (oij, oik, ojk))


def _change(
    pairs: _Pairs, ai: Tensor, aj: Tensor, ii: Tensor | float, jj: Tensor | float, ij: Tensor | float
) -> Tensor:
    """Integral over the plane of |f_i a_i G_i + f_j a_j G_j - f_k a_k G_k|^2, (E,), for features f of which the scalar
    products are given and f_k is the mean by mass."""
    wi, wj, ak = pairs.weight, 1 - pairs.weight, pairs.alphas
    (pi, pj, pk), (oij, oik, ojk) = pairs.areas, pairs.overlaps
    ik, jk = wi * ii + wj * ij, wj * jj + wi * ij
    kk = wi * ik + wj * jk
    alone = ai * ai * ii * pi + aj * aj * jj * pj + ak * ak * kk * pk
    across = ai * aj * ij * oij - ai * ak * ik * oik - aj * ak * jk * ojk
    return (alone / 2 + 2 * across).clamp_min(0)


def _costs(state: _State, first: Tensor, second: Tensor) -> Tensor:
    """Expected change by each merge of the pictures from three sides, (E,) float32, squared colour units times area."""
    # Pass 1, at each Gaussian and from each side: how much covers it (itself included), and the mean colour of that.
    views = (FACE_ON, *SIDEWAYS)
    covers = [state.alphas / 2 for _ in views]
    arounds = [cover[:, None] * state.colours for cover in covers]
    kept = []
    for i, j in zip(first.split(CHUNK), second.split(CHUNK), strict=True):
        joined = _join(state, i, j)
        seen = [_pair(state, i, j, joined, view) for view in views]
        for pairs, cover, around in zip(seen, covers, arounds, strict=True):
            (pi, pj, _), (oij, _, _) = pairs.areas, pairs.overlaps
            on_i = state.alphas[j] * oij / pi.clamp_min(TINY)
            on_j = state.alphas[i] * oij / pj.clamp_min(TINY)
            cover.index_add_(0, i, on_i).index_add_(0, j, on_j)
            around.index_add_(0, i, on_i[:, None] * state.colours[j]).index_add_(0, j, on_j[:, None] * state.colours[i])
        none = joined.means[:0]
        kept.append([dataclasses.replace(pairs, means=none, cov=none) for pairs in seen])  # to save memory
    for cover, around in zip(covers, arounds, strict=True):
        around /= cover[:, None].clamp_min(TINY)
    # Pass 2: the change of colour against the surroundings, and of coverage against the background.
    costs = []
    for i, j, seen in zip(first.split(CHUNK), second.split(CHUNK), kept, strict=True):
        sides = zip(seen, covers, arounds, strict=True)
        costs.append(sum(_cost_seen(state, i, j, pairs, cover, around) for pairs, cover, around in sides).float())
    return torch.cat(costs)


def _cost_seen(state: _State, i: Tensor, j: Tensor, pairs: _Pairs, cover: Tensor, around: Tensor) -> Tensor:
    """:func:`_costs` from one side, given what covers each Gaussian (n,) and its mean colour (n, C)."""
    wi, wj = pairs.weight, 1 - pairs.weight
    here = wi[:, None] * around[i] + wj[:, None] * around[j]
    fi, fj = state.colours[i] - here, state.colours[j] - here
    ii, jj, ij = ((x * y).sum(1) + 3 * LOCAL_CONTRAST**2 for x, y in ((fi, fi), (fj, fj), (fi, fj)))
    ai, aj, one = state.alphas[i], state.alphas[j], torch.ones_like(ii)
    covered = wi * cover[i] + wj * cover[j]
    through = 3 * BACKGROUND_CONTRAST**2 * torch.exp(-4 * covered)
    cost = _change(pairs, ai, aj, ii, jj, ij) / covered.clamp_min(0.5) ** 2
    return cost + through * _change(pairs, ai, aj, one, one, one)


def _cheapest(state: _State, k: int) -> tuple[Tensor, Tensor]:
    """Disjoint pairs to merge in this round."""
    n = len(state)
    first, second, walk = _neighbours(state.means)
    chosen, costs = _match(first, second, n, state)
    if len(chosen) < n / 10:  # the nearest of many coincident centres are all the same few
        first, second = torch.cat([first, walk[:-1]]), torch.cat([second, walk[1:]])
        chosen, costs = _match(first, second, n, state)
    count = max(1, min(n - k, int(n * SHARE_PER_ROUND)))
    chosen = chosen[costs[chosen].sort(stable=True).indices[:count]]
    return first[chosen], second[chosen]


def _match(first: Tensor, second: Tensor, n: int, state: _State, passes: int = 6) -> tuple[Tensor, Tensor]:
    """Indices of disjoint pairs, those that are the cheapest for both members, then the same among what is left;
    and the costs of all pairs (E,)."""
    costs = _costs(state, first, second)
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


def _replace(state: _State, first: Tensor, second: Tensor) -> None:
    """Put each pair's replacement in the place of its first member."""
    for i, j in zip(first.split(CHUNK), second.split(CHUNK), strict=True):
        pairs = _pair(state, i, j, _join(state, i, j))
        state.means[i], state.cov[i], state.alphas[i] = pairs.means, pairs.cov, pairs.alphas
        for values in (state.colours, state.sh):
            weight = pairs.weight[:, None].to(values.dtype)
            values[i] = weight * values[i] + (1 - weight) * values[j]


def _deepened(alphas: Tensor, sizes: Tensor) -> Tensor:
    """Opacities (n,) of Gaussians with ``sizes`` (n,) members: 1 - (1 - alpha)^p, where p = sizes^:data:`DEEPENING`."""
    depth = -torch.log1p(-alphas.clamp_max(OPAQUE)) * sizes.double() ** DEEPENING
    return (-torch.expm1(-depth)).clamp_max(MOST_DRAWN)


def _as_gaussians(state: _State, like: Gaussians) -> Gaussians:
    """The state in the scene's own parametrisation and dtype."""
    from scipy.spatial.transform import Rotation

    variances, axes = torch.linalg.eigh(unpack(state.cov))
    axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]
    quats = torch.from_numpy(Rotation.from_matrix(axes.numpy()).as_quat())[:, [3, 0, 1, 2]]
    sh = state.sh.view(len(state), -1, 3)
    made = Gaussians(
        means=state.means,
        scales=0.5 * variances.clamp_min(TINY).log(),
        quats=quats,
        opacities=torch.logit(state.alphas, 1e-7)[:, None],
        features_dc=sh[:, 0].double(),
        features_rest=sh[:, 1:].double(),
    )
    return made.to(like.dtype)
