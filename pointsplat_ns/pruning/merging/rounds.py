"""The main loop of merging: rounds of pairs down to the count, then the final scene.

All steps run on the scene's device. On a CPU, pieces of work take one thread each: the result is
exact to the bit on any number of threads, and no thread waits for another within an operation. On a
GPU, torch works without kernels and rounds differently; if its memory is too small, the CPU merges.
Merging takes at most 0.35 kB per Gaussian besides the scene itself; freed blocks are returned to
the system before steps that allocate much.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.geometry.neighbours import NearestOf, import_tree, other_neighbours
from pointsplat_ns.pruning.merging.groups import Groups, best_size_change, scene_maker
from pointsplat_ns.pruning.merging.pair_cost import pair_costs
from pointsplat_ns.pruning.merging.pairs import Round, cheapest_pairs, replace_pairs
from pointsplat_ns.pruning.merging.regrouping import regrouped
from pointsplat_ns.pruning.merging.settings import MERGING, MergeSettings
from pointsplat_ns.pruning.merging.state import Participants, State, drawable, initial_state
from pointsplat_ns.pruning.merging.visibility import views_and_weights
from pointsplat_ns.rendering.comparison.sizes import RendersOfSizes, middle_size
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.memory import give_back_freed_memory
from pointsplat_ns.system.tensors import numbers
from pointsplat_ns.system.threads import one_thread_each, parallel_map
from pointsplat_ns.view_sampling.content import in_units, views_in_units
from pointsplat_ns.view_sampling.sampler import Sampler

logger = logging.getLogger("pointsplat_ns")

Result = TypeVar("Result")


@dataclass(frozen=True, eq=False)
class Merged:
    """The result of merging."""

    scene: Gaussians
    """K Gaussians in the order of their first members. Those that were not merged are unchanged,
    exact to the bit."""
    # [N] int64, index in ``scene`` of the Gaussian that each was merged into, or, of points that
    # were selected, is nearest to; -1 if dropped
    assignment: Tensor
    size_change: float = 0.0
    """Added to the log-scales of merged Gaussians; chosen by comparing renders."""

    def to(self, device: torch.device) -> Merged:
        """The same result on a device."""
        return replace(self, scene=self.scene.to(device), assignment=self.assignment.to(device))


def merge(
    scene: Gaussians,
    k: int,
    progress: Callable[[float], None] | None = None,
    views: Views | Sampler | None = None,
    settings: MergeSettings = MERGING,
) -> Merged:
    """Replace a scene by ``k`` Gaussians that look the same.

    Gaussians that are too faint to be drawn are dropped first.

    Args:
        scene: N Gaussians. Those that cannot be drawn
            (:meth:`~pointsplat_ns.scene.gaussians.Gaussians.usable`) are dropped unless ``k`` is N.
        k: number of Gaussians in the result; N returns the scene itself.
        progress: called with the share done, in [0, 1].
        views: views in which the result should look the same, such as the poses of the scene's
            photos. Gaussians that none of them shows are merged first. A sampler of the same scene,
            or of one that looks the same, samples views; by default a new sampler does.
        settings: the tuned numbers.

    Returns:
        Exactly ``k`` Gaussians, on the device of the scene. Deterministic on a CPU.

    Raises:
        BudgetError: if ``k`` is not in 1..N, or fewer than ``k`` Gaussians can be drawn.
    """
    return next(merge_levels(scene, [k], progress, views, settings))


def merge_levels(
    scene: Gaussians,
    counts: Sequence[int],
    progress: Callable[[float], None] | None = None,
    views: Views | Sampler | None = None,
    settings: MergeSettings = MERGING,
) -> Iterator[Merged]:
    """Replace a scene by fewer and fewer Gaussians in one pass.

    Each level is merged from the previous one: Gaussians merged in one level stay merged in all
    later levels. So several levels are not regrouped, and are slightly worse than results of
    :func:`merge`.

    Args:
        scene: N Gaussians, see :func:`merge`.
        counts: number of Gaussians of each level, in 1..N, descending without repetition.
        progress: called with the share done over all levels, in [0, 1].
        views, settings: as for :func:`merge`.

    Yields:
        A level for each count, as soon as it is reached.

    Raises:
        BudgetError: if a count is not in 1..N, the counts do not descend, or the first exceeds the
            number of drawable Gaussians.
    """
    n = len(scene)
    for k in counts:
        if not 1 <= k <= n:
            raise BudgetError(f"cannot merge {n} Gaussians into {k}; expected 1 to {n}")
    if any(fewer >= more for more, fewer in itertools.pairwise(counts)):
        raise BudgetError(
            f"levels of {', '.join(map(str, counts))} Gaussians; expected descending counts"
        )
    return _levels(scene, counts, progress or (lambda share: None), views, settings)


def _on_cpu_if_too_large(scene: Gaussians, function: Callable[[Gaussians], Result]) -> Result:
    """Result of a function of a scene; moves the scene to the CPU if a GPU has too little memory,
    or lacks float64."""
    if scene.device.type == "mps":
        scene = scene.to("cpu")
    try:
        return function(scene)
    except torch.OutOfMemoryError:
        if scene.device.type == "cpu":
            raise
        logger.warning(
            "%s has too little memory to merge %d Gaussians: using the CPU, which is slower",
            scene.device,
            len(scene),
        )
    return function(scene.to("cpu"))


class Merger:
    """Merges one scene to several counts, each as :func:`merge` does. Views and all but the last
    round of a count are shared with every smaller count, and computed once.

    The stored steps take at most 0.4 kB per Gaussian of the scene.
    Args:
        scene, views, settings: as for :func:`merge`.
    """

    def __init__(
        self,
        scene: Gaussians,
        views: Views | Sampler | None = None,
        settings: MergeSettings = MERGING,
    ):
        self._scene = scene
        self._device = scene.device
        self._options = (views, settings)
        self._steps: list[Step] = []  # after rounds with the maximum number of pairs

    @torch.no_grad()
    def merged(self, k: int, progress: Callable[[float], None] | None = None) -> Merged:
        """The result of :func:`merge`, exact to the bit. Arguments and errors as there."""
        report = progress or (lambda share: None)

        def on(scene: Gaussians) -> Merged:
            if scene is not self._scene:  # it was moved, unlike the earlier steps
                self._scene = scene
                self._steps = []
            return self._merged(k, report)

        return _on_cpu_if_too_large(self._scene, on).to(self._device)

    def _merged(self, k: int, report: Callable[[float], None]) -> Merged:
        views, settings = self._options
        if not self._steps and 1 <= k < len(self._scene):
            self._steps.append(first_step(self._scene, 1, views, settings, report=report))
        # includes faint Gaussians
        if not self._steps or not 1 <= k <= len(self._steps[0].state):
            return merge(self._scene, k, report, views, settings)
        step = next(step for step in reversed(self._steps) if len(step.state) >= k)
        first = len(step.state)
        while (n := len(step.state)) > k:
            shared = step is self._steps[-1] and n - most_pairs(n, settings) >= k
            step = one_round(step, k, settings)
            self._steps += [step] if shared else []
            report(_share_done(first, len(step.state), k))
        merged = _result(step, True, settings)
        report(1.0)
        return merged


@torch.no_grad()
def _levels(
    scene: Gaussians,
    counts: Sequence[int],
    report: Callable[[float], None],
    views: Views | Sampler | None,
    settings: MergeSettings,
) -> Iterator[Merged]:
    n = len(scene)
    if n in counts:
        report(0.0 if len(counts) > 1 else 1.0)
        yield Merged(scene, numbers(n, scene.device))
        counts = counts[1:]
    if not counts:
        return

    def merged_levels(scene: Gaussians) -> Iterator[Merged]:
        step = first_step(scene, counts[0], views, settings, counts[-1], report)
        first = len(step.state)
        for k in counts:
            while len(step.state) > k:
                step = one_round(step, k, settings)
                report(_share_done(first, len(step.state), counts[-1]))
            merged = _result(step, len(counts) == 1, settings)
            if k == counts[-1]:
                report(1.0)
            yield merged

    def begun(scene: Gaussians) -> tuple[Merged, Iterator[Merged]]:
        levels = merged_levels(scene)
        return next(levels), levels

    level, others = _on_cpu_if_too_large(scene, begun)  # the first takes most memory
    for each in itertools.chain([level], others):
        yield each.to(scene.device)


def _share_done(first: int, now: int, last: int) -> float:
    """Share done after a round: views and weights take about half of the time, the end a sixth."""
    return 0.5 + 0.35 * (first - now) / max(first - last, 1)


@dataclass(frozen=True, eq=False)
class Step:
    """State between two rounds."""

    participants: Participants
    views: Views | None  # used for visibility
    state: State
    rounds: tuple[Round, ...] = ()
    reference: RendersOfSizes | None = None
    """Renders of the scene, or of the remaining Gaussians once they were few enough to render."""

    def groups(self) -> Groups:
        """Groups of the participants, one per remaining Gaussian."""
        return Groups.of(self.participants, self.state, self.rounds)


def first_step(
    scene: Gaussians,
    k: int,
    views: Views | Sampler | None,
    settings: MergeSettings,
    last: int = 0,
    report: Callable[[float], None] = lambda share: None,
) -> Step:
    """The step before the first round, with at least ``k`` Gaussians; ``views`` as for
    :func:`merge`. There are no renders if no round follows, for at most the ``last`` count."""
    with one_thread_each():
        members = drawable(scene, k)
        begin: list[Callable[[], Any]] = [lambda: Participants.of(scene, members)]
        if len(members) > last:
            if not isinstance(views, Views) and len(members) >= settings.min_count_rendered:
                views = views or Sampler(scene)
                begin.append(views.prepare)
            if scene.device.type == "cpu":  # other devices use another tree
                begin.append(import_tree)
        participants, *_ = parallel_map(lambda step: step(), begin, scene.device)
        give_back_freed_memory()  # of finished threads
        found = None
        weights = torch.ones_like(participants.members, dtype=torch.float32)
        blurs = None
        if len(participants) > last:
            found, (weights, blurs) = views_and_weights(
                participants, views, settings, lambda share: report(0.5 * share)
            )
        participants = replace(participants, blurs=blurs)
        return _with_reference(
            Step(participants, found, initial_state(participants, weights)), settings
        )


def most_pairs(n: int, settings: MergeSettings) -> int:
    """Maximum number of pairs that a round merges of ``n`` Gaussians."""
    return max(1, int(n * settings.round_share))


def one_round(step: Step, k: int, settings: MergeSettings) -> Step:
    """The step after another round; at least ``k`` Gaussians remain."""
    n = len(step.state)
    most = min(n - k, most_pairs(n, settings))
    with one_thread_each():
        give_back_freed_memory()
        near = other_neighbours(step.state.means.double(), settings.neighbours)
        costs = pair_costs(step.state, near, settings)
        first, second, _ = cheapest_pairs(near, costs, settings.matching_passes)
        del near, costs
        give_back_freed_memory()
        if not len(first):
            raise RuntimeError(f"a round found no pair among {n} Gaussians")  # would never end
        state, merged = replace_pairs(step.state, first[:most], second[:most], settings)
        return _with_reference(replace(step, state=state, rounds=(*step.rounds, merged)), settings)


def _with_reference(step: Step, settings: MergeSettings) -> Step:
    """A step with reference renders, subsampled from images of the middle size
    (:func:`~pointsplat_ns.rendering.comparison.sizes.sides_of`); unchanged if it has some already,
    too many Gaussians, or no views."""
    everyone = step.participants
    views = step.views
    if (
        step.reference
        or views is None
        or len(step.state) > settings.max_count_rendered
        or settings.finish_views < 1
    ):
        return step
    if step.rounds:
        dense = scene_maker(everyone, step.groups(), settings)[1](0.0)
    else:
        dense = (
            everyone.scene
            if len(everyone) == len(everyone.scene)
            else everyone.scene[everyone.members]
        )
    unit = everyone.centre, everyone.size
    views = views_in_units(views.spread(settings.finish_views), *unit)
    return replace(step, reference=RendersOfSizes(in_units(dense, *unit), [middle_size(views)]))


def _result(step: Step, regroup: bool, settings: MergeSettings) -> Merged:
    """The result after the last round."""
    participants = step.participants
    reference = step.reference
    with one_thread_each():
        groups = step.groups()
        any_merged = groups.any_merged
        if regroup and any_merged and settings.regrouping_rounds > 0:
            groups = regrouped(participants, groups, settings)
        give_back_freed_memory()
        group, make = scene_maker(participants, groups, settings)
        del groups
        assignment = group.new_full((len(participants.scene),), -1)
        assignment[participants.members] = group
        if reference is None or not any_merged:
            return Merged(make(0.0), assignment)

        def psnr(scene: Gaussians) -> float:
            return reference.psnr(in_units(scene, participants.centre, participants.size))

        size_change = best_size_change(lambda change: psnr(make(change)))
        merged = Merged(make(size_change), assignment, size_change)
        if regroup and participants.blurs is not None:
            selected = _selected(participants, len(merged.scene))
            merged = max(merged, selected, key=lambda one: psnr(one.scene))
        return merged


def _selected(participants: Participants, k: int) -> Merged:
    """The ``k`` most opaque participants; each other one is assigned to the nearest of them."""
    scene = participants.scene
    members = participants.members
    rows = participants.most_opaque(k)
    assignment = members.new_full((len(scene),), -1)
    nearest = NearestOf(scene.means[rows].double(), 1)
    assignment[members] = nearest(scene.means[members].double())[:, 0].to(members.dtype)
    assignment[rows] = numbers(k, members.device)  # where several are at one place
    return Merged(scene[rows], assignment)
