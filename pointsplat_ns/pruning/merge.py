"""Merging: replaces a scene by fewer Gaussians that look the same, from the scene's 3D attributes alone.

Over a few rounds, pairs of neighbours are replaced by one Gaussian with their common mass (opacity times the area of
the projection), centre, covariance and colour. The cost of a pair is the expected change of rendered images, see
:mod:`~pointsplat_ns.pruning.pair_costs`, as large as it appears from where the scene is looked at, see
:mod:`~pointsplat_ns.pruning.viewpoints` and :mod:`~pointsplat_ns.looking.traces`, and less where others stand in front,
see :mod:`~pointsplat_ns.pruning.visibility`. Then members go to the group that they fit best, see
:mod:`~pointsplat_ns.pruning.regrouping`. Small renders choose two numbers of the result, see
:mod:`~pointsplat_ns.pruning.finishing`, and whether members do change groups.

Everything is computed on one thread each, in pieces that several threads take: so the result is the same bits on any
number of threads, and no thread waits for another within an operation.

Memory: besides the scene itself about 0.4 kB a Gaussian. SH coefficients are read twice, in pieces: for the principal
axes of colours, and at the end for the means of members.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.morton import curve_keys, unit_cells
from pointsplat_ns.geometry.neighbours import other_neighbours
from pointsplat_ns.geometry.quaternions import quaternions_of
from pointsplat_ns.looking.content import content_size, in_units, positions_in_units, some_of, thinned, views_in_units
from pointsplat_ns.looking.sampling import PROBED, is_room
from pointsplat_ns.looking.traces import how_much_seen, photo_places
from pointsplat_ns.looking.windows import RESOLUTION
from pointsplat_ns.pruning.covariance import TINY, shadow, unpack
from pointsplat_ns.pruning.duplicates import Copies, Reduced
from pointsplat_ns.pruning.finishing import Finish, Reference
from pointsplat_ns.pruning.matching import cheapest_pairs
from pointsplat_ns.pruning.merge_state import OPAQUE, grown, start
from pointsplat_ns.pruning.pair_costs import costs_of
from pointsplat_ns.pruning.regrouping import ROUNDS, masses_of, moments, regrouped
from pointsplat_ns.pruning.viewpoints import NOT_SHOWN, viewpoints, weights_seen, weights_seen_from
from pointsplat_ns.pruning.visibility import MOST_DRAWN, Shown
from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN
from pointsplat_ns.system.pieces import CHUNK
from pointsplat_ns.system.threads import one_thread_each
from pointsplat_ns.views import Views

NEIGHBOURS = 8
"""Number of nearest centres that a Gaussian may be merged with."""

SHARE_PER_ROUND = 0.4
"""Share of the remaining Gaussians that may be merged away in one round. Smaller shares are greedier and measured
worse: the cost of a pair does not include earlier losses of its members, and even thinning keeps losses small."""

FEWEST_SEEN, MOST_SEEN = 2_000, 2_000_000
"""Smallest and largest number of Gaussians of a scene that is looked at and rendered to choose the numbers of
:class:`Finish`. Smaller ones are merged in less time than that takes."""

TOLD_TWICE = 0.5
"""Exponent of how much photos showed where views were given and what they show was counted, which tells a part of the
same. Set on two captures (second trainings, 50 to 3 %), where it gains 0.0 to 0.6 dB over 1; on two others, -0.2 to
0.2."""

UNTOLD = 0.25
"""Exponent of how much photos showed of a place, in rooms that do not tell where these were taken. In held-out poses of
three rooms it gains 0.1 to 0.5 dB, in sampled views of another it loses 0.1; larger ones gain and lose more. Of what is
looked at from outside, sampled views gain nothing."""


@dataclass(frozen=True, eq=False)
class Merged:
    """The result of merging."""

    scene: Gaussians
    """K Gaussians in the order of their first members. Those not merged with any other are unchanged to the bit."""
    assignment: Tensor  # [N] int64, index in ``scene`` of the Gaussian that each was merged into; -1 if dropped
    finish: Finish
    """The numbers chosen for this scene."""


def merge(
    scene: Gaussians,
    k: int,
    progress: Callable[[float], None] | None = None,
    views: Views | None = None,
    resolution: tuple[int, int] = RESOLUTION,
) -> Merged:
    """Replace a scene by ``k`` Gaussians that look the same.

    Gaussians too faint to be drawn are dropped first. Of the others, exact copies become one, and the rest is merged in
    pairs, cheapest first.

    Args:
        scene: N Gaussians. Those that are not :meth:`~pointsplat_ns.gaussians.Gaussians.usable` are dropped, unless
            ``k`` is N.
        k: number of Gaussians in the result; N returns the scene itself.
        progress: called with the share done, in [0, 1].
        views: where the scene is looked at from, such as the poses of its photos; what they do not show is merged
            first. By default from about where photos were taken, if the scene tells
            (:mod:`~pointsplat_ns.looking.traces`), else from free places in it, in all directions.
        resolution: width and height of the pictures, pixels, where no views are given.

    Returns:
        Exactly ``k`` Gaussians. Deterministic.

    Raises:
        BudgetError: if ``k`` is not in 1..N, or fewer than ``k`` Gaussians can be drawn.
    """
    return next(merge_levels(scene, [k], progress, views, resolution))


def merge_levels(
    scene: Gaussians,
    counts: Sequence[int],
    progress: Callable[[float], None] | None = None,
    views: Views | None = None,
    resolution: tuple[int, int] = RESOLUTION,
) -> Iterator[Merged]:
    """Replace a scene by fewer and fewer Gaussians in one pass.

    Each level is merged from the one before: Gaussians that are one in a level are one in all that follow. So several
    levels are not regrouped, and each is a little worse than what :func:`merge` makes.

    Args:
        scene: N Gaussians, see :func:`merge`.
        counts: number of Gaussians of each level, in 1..N, descending without repetition.
        progress: called with the share done of all levels, in [0, 1].
        views: where the scene is looked at from; by default from free places in it.
        resolution: as for :func:`merge`.

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
    return _levels(scene, counts, progress or (lambda share: None), views, resolution)


@torch.no_grad()
def _levels(
    scene: Gaussians,
    counts: Sequence[int],
    report: Callable[[float], None],
    views: Views | None,
    resolution: tuple[int, int],
) -> Iterator[Merged]:
    n = len(scene)
    if n in counts:
        report(0.0 if len(counts) > 1 else 1.0)
        yield Merged(scene, torch.arange(n, device=scene.device), Finish())
        counts = counts[1:]
    if not counts:
        return
    dense = scene.to(device="cpu")
    with one_thread_each():
        copies = Copies(dense, _visible(dense, counts[0]))
    first, last = len(copies), counts[-1]
    reduced: Reduced | None = None
    for k in counts:
        left = max(k, copies.distinct)
        if reduced is None or left < len(reduced.members):
            with one_thread_each():
                reduced = copies.reduced(left)
                merging = Merging(reduced.scene, reduced.members, views, resolution)
        while len(merging) > k:
            with one_thread_each():
                merging.round(k)
            report(0.95 * (first - len(merging)) / max(first - last, 1))
        with one_thread_each():
            merged = merging.level(regroups=len(counts) == 1)
        if k == last:
            report(1.0)
        assignment = merged.assignment[reduced.index]
        yield Merged(merged.scene.to(scene.device), assignment.to(scene.device), merged.finish)


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


@dataclass
class Tree:
    """Which Gaussians were merged, and in what shares."""

    owner: Tensor  # [n] int32, the Gaussian that each is merged into, itself if it remains
    rounds: list[tuple[Tensor, Tensor, Tensor]] = field(default_factory=list)
    """First and second members (int32) of the pairs of each round, and the share of the first in the mass (float32)."""

    def record(self, first: Tensor, second: Tensor, shares: Tensor) -> None:
        """Note a round."""
        self.owner[second] = first.to(torch.int32)
        self.rounds.append((first.to(torch.int32), second.to(torch.int32), shares))

    def roots(self) -> Tensor:
        """The remaining Gaussian that each is part of, (n,) int32."""
        while True:
            above = self.owner[self.owner.long()]
            if torch.equal(above, self.owner):
                return self.owner
            self.owner = above

    def shares(self) -> Tensor:
        """Share of each in the mass of the Gaussian that it is part of, (n,) float32: the product of its shares in all
        rounds, from the last to the first."""
        shares = torch.ones(len(self.owner))
        for first, second, share in reversed(self.rounds):
            i, j = first.long(), second.long()
            shares[j] = shares[i] * (1 - share)
            shares[i] *= share
        return shares


@dataclass(frozen=True, eq=False)
class Groups:
    """Members that are one Gaussian each."""

    place: Tensor  # [n] int64, the group of each member
    shares: Tensor  # [n] float32, of each member in the mass of its group
    first: Tensor  # [K] int64, index in the scene of the first member
    means: Tensor  # [K, 3] float64
    cov: Tensor  # [K, 6] float64
    alphas: Tensor  # [K] float64
    sizes: Tensor  # [K] int32, number of members

    def in_order(self) -> Groups:
        """The groups in the order of their first members."""
        order = self.first.argsort()
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order))
        ordered = (values[order] for values in (self.first, self.means, self.cov, self.alphas, self.sizes))
        return Groups(rank[self.place], self.shares, *ordered)


class Merging:
    """A scene while it is merged.

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) ascending indices of those that take part.
        views: where the scene is looked at from; by default from free places in it.
        resolution: as for :func:`merge`.
    """

    def __init__(
        self,
        scene: Gaussians,
        members: Tensor,
        views: Views | None,
        resolution: tuple[int, int] = RESOLUTION,
    ):
        self.scene = scene
        # Along a space-filling curve, neighbours are near each other in memory.
        self.members = members[curve_keys(unit_cells(scene.means[members])).argsort(stable=True)]
        self.centre, self.size = content_size(scene)
        self.given = views
        self.views = views_in_units(views, self.centre, self.size) if views is not None else None
        self.photos: tuple[Tensor, Tensor] | None = None
        if self.views is None and len(members) >= FEWEST_SEEN:
            content = in_units(scene, self.centre, self.size)
            self.photos = photo_places(content)
            self.views = viewpoints(content, self.photos, *resolution)
        weights, self.seen = self._weights()
        self.state = start(scene, self.members, weights, self.centre, self.size)
        self.tree = Tree(torch.arange(len(self.members), dtype=torch.int32))
        self.alive = torch.arange(len(self.members))  # [n left] index in members
        self.reference: Reference | None = None
        self._see()

    def __len__(self) -> int:
        return len(self.state)

    def round(self, k: int) -> None:
        """Merge some pairs, until at least ``k`` Gaussians are left."""
        n = len(self)
        near = other_neighbours(self.state.means, NEIGHBOURS)
        first, second = cheapest_pairs(near, costs_of(self.state, near), max(1, min(n - k, int(n * SHARE_PER_ROUND))))
        shares = self.state.replace_pairs(first, second)
        self.tree.record(self.alive[first], self.alive[second], shares)
        left = torch.ones(n, dtype=torch.bool)
        left[second] = False
        self.alive = self.alive[left]
        self.state.keep(left)
        self._see()

    def level(self, regroups: bool = False) -> Merged:
        """The Gaussians that remain, as a scene; if that is asked for, with members that changed groups, where small
        renders do not gain by leaving them."""
        groups = self._groups().in_order()
        if regroups and bool((groups.sizes > 1).any()):
            other = self._regrouped(groups).in_order()
            if self._closeness(other) >= self._closeness(groups):
                groups = other
        scene, finish = self._finished(groups)
        assignment = torch.full((len(self.scene),), -1)
        assignment[self.members] = groups.place
        return Merged(scene, assignment, finish)

    def _groups(self) -> Groups:
        """What was merged."""
        place = torch.empty(len(self.members), dtype=torch.int64)
        place[self.alive] = torch.arange(len(self.alive))
        place = place[self.tree.roots().long()]
        state = self.state
        return Groups(
            place, self.tree.shares(), self._first(place), state.means, state.cov, state.alphas, state.members
        )

    def _first(self, place: Tensor) -> Tensor:
        """Index in the scene of the first member of each group."""
        first = torch.full((len(self),), len(self.scene))
        return first.scatter_reduce_(0, place, self.members, "amin")

    def _regrouped(self, groups: Groups) -> Groups:
        """Groups whose members fit them better, as far as they are seen. Of their mass, as much is seen as before."""
        scene, members, place, count = self.scene, self.members, groups.place, len(self)
        masses = masses_of(scene, members).mul_(self.seen)
        common = moments(scene, members, masses, place, count)
        seen = groups.alphas * shadow(groups.cov) / common.mass.clamp_min(TINY)
        for _ in range(ROUNDS):
            place = regrouped(scene, members, masses, place, common)
            common = moments(scene, members, masses, place, count)
        alphas = torch.where(common.mass > TINY, seen * common.mass / shadow(common.cov).clamp_min(TINY), groups.alphas)
        return Groups(
            place,
            common.shares.float(),
            self._first(place),
            common.means,
            grown(common.cov, alphas),
            alphas.clamp_max(OPAQUE),
            torch.bincount(place, minlength=count).to(torch.int32),
        )

    def _weights(self) -> tuple[Tensor, Tensor]:
        """How large a unit of area at each member is to those who look, (n,), and how much is seen of each, (n,)."""
        if self.views is None:
            return torch.ones(len(self.members)), torch.ones(()).expand(len(self.members))
        means = positions_in_units(self.scene.means[self.members], self.centre, self.size)
        if self.given is not None:
            weights, told = weights_seen(means, self.views, NOT_SHOWN), TOLD_TWICE
        elif self.photos is not None:
            weights, told = weights_seen_from(means, *self.photos), 1.0
        else:
            weights = weights_seen(means, self.views)
            told = UNTOLD if is_room(thinned(self.scene, PROBED)) else 0.0
        around, seen = self._shown(weights, self.views)
        weights = weights * around
        return weights * how_much_seen(self.scene, self.members) ** told if told else weights, seen

    def _shown(self, weights: Tensor, views: Views) -> tuple[Tensor, Tensor]:
        """Root of the share of the neighbourhood of each member that views really show, (n,), and of each by itself; in
        a large scene, that of one of several members along the curve."""
        scene, members, step = self.scene, self.members, -(-len(self.members) // MOST_DRAWN)
        if step > 1:
            scene = some_of(scene, members, step)
            members, weights = torch.arange(len(scene)), weights[::step]
        shown = Shown.of(in_units(scene, self.centre, self.size), members, weights, views)
        around, each = (share.repeat_interleave(step)[: len(self.members)] for share in (shown.around(), shown.each()))
        return around, each

    def _see(self) -> None:
        """Render what remains, once it is few enough."""
        if self.reference is None and self.views is not None and len(self) <= MOST_SEEN:
            if self.tree.rounds:
                now = self._made(self._groups())(Finish())
            else:
                now = self.scene[self.members] if len(self.members) < len(self.scene) else self.scene
            self.reference = Reference(in_units(now, self.centre, self.size), self.views)

    def _closeness(self, groups: Groups) -> float:
        """PSNR in windows of groups with the default finish, dB; 0 if the scene is not rendered."""
        return 0.0 if self.reference is None else self.reference.psnr(self._in_units(groups)(Finish()))

    def _in_units(self, groups: Groups) -> Callable[[Finish], Gaussians]:
        """As :meth:`_made`, with the scene in units of the content."""
        make = self._made(groups)
        return lambda finish: in_units(make(finish), self.centre, self.size)

    def _finished(self, groups: Groups) -> tuple[Gaussians, Finish]:
        """The scene of groups with the finish that suits it, and that."""
        make = self._made(groups)
        if self.reference is None or not bool((groups.sizes > 1).any()):
            return make(Finish()), Finish()
        finish = self.reference.best(self._in_units(groups))
        return make(finish), finish

    def _sh(self, groups: Groups, alone: Tensor) -> tuple[Tensor, Tensor]:
        """SH coefficients (K, 3) and (K, (d+1)^2 - 1, 3): means by mass over the members; those of a group of one,
        ``alone`` (K,), are its own, to the bit."""
        scene, place = self.scene, groups.place
        wide = torch.promote_types(scene.dtype, torch.float32)
        means = []
        for values in (scene.features_dc, scene.features_rest):
            mean = torch.zeros(len(alone), *values.shape[1:], dtype=wide)
            for these in torch.arange(len(place)).split(CHUNK):
                own = values[self.members[these]].to(wide)
                mean.index_add_(0, place[these], own * groups.shares[these].to(wide).view(-1, *[1] * (own.dim() - 1)))
                single = alone[place[these]]
                mean[place[these][single]] = own[single]
            means.append(mean.to(scene.dtype))
        return means[0], means[1]

    def _made(self, groups: Groups) -> Callable[[Finish], Gaussians]:
        """A function from a finish to the scene of groups (K)."""
        like, sizes = self.scene, groups.sizes.double()
        sh = self._sh(groups, sizes == 1)
        alone = (sizes == 1)[:, None]
        scales, quats = _axes(groups.cov)
        means = torch.where(alone, like.means[groups.first], groups.means.to(like.dtype))
        quats = torch.where(alone, like.quats[groups.first], quats.to(like.dtype))

        def make(finish: Finish) -> Gaussians:
            logits = torch.logit(deepened(groups.alphas, sizes, finish.deepening), 1e-7)[:, None].to(like.dtype)
            spread = torch.where(alone, like.scales[groups.first], (scales + finish.spread).to(like.dtype))
            return Gaussians(means, spread, quats, torch.where(alone, like.opacities[groups.first], logits), *sh)

        return make


def deepened(alphas: Tensor, sizes: Tensor, power: float) -> Tensor:
    """Opacities (n,) of Gaussians with ``sizes`` (n,) members: 1 - (1 - alpha)^(sizes^power)."""
    depth = -torch.log1p(-alphas.clamp_max(OPAQUE)) * sizes.double() ** power
    return (-torch.expm1(-depth)).clamp_max(ALPHA_MAX)


def _axes(cov: Tensor) -> tuple[Tensor, Tensor]:
    """Log-scales (n, 3) and quaternions (n, 4) of covariances (n, 6)."""
    scales, quats = torch.empty(len(cov), 3, dtype=torch.float64), torch.empty(len(cov), 4, dtype=torch.float64)
    for these in torch.arange(len(cov)).split(CHUNK):
        variances, axes = torch.linalg.eigh(unpack(cov[these]))
        axes[:, :, 0] *= torch.linalg.det(axes).sign()[:, None]
        scales[these] = 0.5 * variances.clamp_min(TINY).log()
        quats[these] = quaternions_of(axes)
    return scales, quats
