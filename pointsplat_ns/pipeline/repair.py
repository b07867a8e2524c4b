"""Repairs a smaller scene by learned optimisation steps against renders of the dense scene, each in
another view."""

from __future__ import annotations

import functools
import itertools
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torch import Tensor

from pointsplat_ns.pipeline.feedback_features import REPAIR, Feedback
from pointsplat_ns.pipeline.optimiser import TOGETHER, optimised
from pointsplat_ns.pipeline.photos.examples import Example, render_of
from pointsplat_ns.pipeline.repair_budget import RepairBudget
from pointsplat_ns.pipeline.repair_state import Unfinished
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.refinement.feedback import FeedbackRefiner, shipped_feedback_refiner
from pointsplat_ns.refinement.schedules import cosine_factor
from pointsplat_ns.rendering.comparison.sizes import SMALLEST_SIDE
from pointsplat_ns.scene.gaussians import Gaussians


@dataclass(frozen=True)
class Repaired:
    """A repaired scene, and its cost."""

    scene: Gaussians
    steps: int
    seconds: float
    interrupted: bool
    """Whether Ctrl-C ended the repair early."""


def repair(
    scene: Gaussians,
    dense: Gaussians,
    views: ViewProvider,
    budget: RepairBudget,
    progress: Callable[[float], None] | None = None,
    network: FeedbackRefiner | Literal["shipped"] | None = "shipped",
    psnr: float = 0.0,
    unfinished: Path | None = None,
) -> Repaired:
    """Optimise a smaller scene against renders of the dense one; its number of Gaussians does not
    change.

    Each step renders both scenes in one view. A network reads the gradients of each Gaussian and
    sets how far it moves (:mod:`~pointsplat_ns.refinement.feedback`). The views come from
    :meth:`ViewProvider.others`: other views than those of comparisons, each once before any is
    repeated. Ctrl-C ends the repair, and the scene of the last step is returned.

    Args:
        scene: K Gaussians; not changed.
        dense: N Gaussians on the same device.
        views: source of views.
        budget: length of the repair, for a scene of few Gaussians; see
            :meth:`RepairBudget.for_count`.
        progress: called with the share done, in [0, 1].
        network: on the scene's device; by default the shipped one, None for plain Adam.
        psnr: PSNR of ``scene`` over the pixels that the dense scene covers, dB. Above
            ``REPAIR.nearly_right`` the steps are smaller.
        unfinished: a file for the state of a repair of a number of steps, each minute. If it is
            there, and of the same repair, the steps continue from it, to the same bits. The caller
            removes it.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    budget = budget.for_count(len(scene))
    run = OptimisationRun(budget)
    if network == "shipped":
        network = shipped_feedback_refiner(scene.device)
    feedback = Feedback(scene, len(dense))
    first_factor = budget.rate * initial_rate_factor(psnr)
    work = len(dense), budget, psnr, views.compared().viewmats.tolist()
    file = Unfinished(None if budget.seconds is not None else unfinished, scene, work)

    def state_of(scene: Gaussians) -> dict[str, Tensor]:
        return {**feedback.state(), **dict(scene.items())}

    found = file.state(state_of(scene))
    if found is not None:
        run.count, state = found
        run.done = budget.share_done(run.count, 0.0)
        feedback.restore(state, run.count)
        scene = scene.replace(**{name: state[name] for name, _ in scene.items()})

    def choose(scene: Gaussians) -> tuple[float, Tensor | None]:
        factors = None
        if network is not None:
            if budget.seconds is None:
                expected = budget.steps
            else:
                expected = round(run.count / run.done) if run.done else REPAIR.most_steps
            factors = feedback.factors(network, scene, run.done, expected)
        return first_factor * cosine_factor(run.done, REPAIR.last_factor), factors

    def kept(scenes: Iterator[Gaussians], first: int) -> Iterator[Gaussians]:
        for count, scene in enumerate(scenes, first + 1):
            if count % TOGETHER == 0:
                file.save(count, functools.partial(state_of, scene))
            yield scene

    examples = _examples(dense, views, budget.growth, run.count)
    last = run.take(scene, kept(optimised(scene, feedback, examples, choose), run.count), progress)
    return Repaired(last, run.count, run.seconds, run.interrupted)


@dataclass
class OptimisationRun:
    """The steps of an optimisation within a budget, counted and timed."""

    budget: RepairBudget
    count: int = 0
    done: float = 0.0
    """Used share of the budget; 1 or more at the end."""
    interrupted: bool = False
    """Whether Ctrl-C ended the steps early."""

    def __post_init__(self) -> None:
        self._start = time.perf_counter()

    @property
    def seconds(self) -> float:
        """Seconds since this object was made."""
        return time.perf_counter() - self._start

    def take(
        self,
        scene: Gaussians,
        scenes: Iterator[Gaussians],
        progress: Callable[[float], None] | None = None,
    ) -> Gaussians:
        """The scene after the last step: take steps until the budget is used, or Ctrl-C.

        Args:
            scene: the scene before the first step.
            scenes: the scene after each step, without end.
            progress: called with the share done, in [0, 1].
        """
        try:
            while self.done < 1 and not self.budget.empty:
                scene = next(scenes)
                self.count += 1
                self.done = self.budget.share_done(self.count, self.seconds)
                if progress is not None:
                    progress(min(self.done, 1.0))
        except KeyboardInterrupt:
            self.interrupted = True
        return scene


def _examples(
    dense: Gaussians, views: ViewProvider, growth: float, taken: int = 0
) -> Iterator[Callable[[], Example]]:
    """Views after those ``taken``, and renders of the dense scene in them, without end.

    For ``growth`` times the steps, there are so many times the sampled views and pixels: a large
    scene has more Gaussians between the pixels, and its projection takes most of the time. A view
    that comes again is not drawn again, as long as it is among the last 256, or fewer of more
    pixels.
    """
    count = round(growth * VIEW_COUNTS.stepped)
    side = round(math.sqrt(growth) * SMALLEST_SIDE)

    drawn = functools.lru_cache(maxsize=round(256 / growth))(
        render_of
    )  # 0.2 GB where pictures are 16 to 9
    others = itertools.islice(views.others(count=count, drawn_side=side), taken, None)
    return (functools.partial(drawn, dense, view) for view in others)


def initial_rate_factor(psnr: float) -> float:
    """Factor on all learning rates for a scene of some PSNR, dB: 1 up to ``REPAIR.nearly_right``,
    then proportional to the root mean square error.

    Example:
        >>> [round(initial_rate_factor(psnr), 3) for psnr in (20, 35, 41, 55)]
        [1.0, 1.0, 0.501, 0.1]
    """
    return min(1.0, 10 ** ((REPAIR.nearly_right - psnr) / 20))
