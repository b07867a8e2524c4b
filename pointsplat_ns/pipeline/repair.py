"""Repairs a smaller scene by learned optimisation steps against renders of the dense scene."""

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
from pointsplat_ns.pipeline.optimiser import VIEWS_AT_ONCE, optimised
from pointsplat_ns.pipeline.photos.examples import Example, render_of
from pointsplat_ns.pipeline.repair_budget import RepairBudget
from pointsplat_ns.pipeline.repair_state import RepairStateFile
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
    """Optimise a smaller scene against renders of the dense one. The number of Gaussians does not
    change.

    Each step renders both scenes in one view. A network reads the gradients of each Gaussian and
    sets its step length (:mod:`~pointsplat_ns.refinement.feedback`). Views come from
    :meth:`ViewProvider.others`, which excludes views of comparisons. Ctrl-C ends the repair; the
    result is the scene of the last step.

    Args:
        scene: K Gaussians; not changed.
        dense: N Gaussians on the same device.
        views: source of views.
        budget: length of the repair, before :meth:`RepairBudget.for_count`.
        progress: called with the share done, in [0, 1].
        network: network on the scene's device; by default the shipped one; None for plain Adam.
        psnr: PSNR of ``scene`` over the pixels that the dense scene covers, dB. Above
            ``REPAIR.nearly_right``, steps are smaller.
        unfinished: file for the state of a repair with a number of steps, written every minute. If
            it exists and is of the same repair, the repair continues from it, bit for bit. The
            caller removes the file.

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
    file = RepairStateFile(None if budget.seconds is not None else unfinished, scene, work)

    def state_of(scene: Gaussians) -> dict[str, Tensor]:
        return {**feedback.state(), **dict(scene.items())}

    resumed = file.state(state_of(scene))
    if resumed is not None:
        run.count, state = resumed
        run.done = budget.share_done(run.count, 0.0)
        feedback.restore(state, run.count)
        scene = scene.replace(**{name: state[name] for name, _ in scene.items()})

    def choose(scene: Gaussians) -> tuple[float, Tensor | None]:
        factors = None
        if network is not None:
            if budget.seconds is None:
                expected = budget.steps
            else:
                expected = round(run.count / run.done) if run.done else network.most_steps
            factors = feedback.factors(network, scene, run.done, expected)
        return first_factor * cosine_factor(run.done, REPAIR.last_factor), factors

    def saving_state(scenes: Iterator[Gaussians], first: int) -> Iterator[Gaussians]:
        for count, scene in enumerate(scenes, first + 1):
            if count % VIEWS_AT_ONCE == 0:
                file.save(count, functools.partial(state_of, scene))
            yield scene

    examples = _examples(dense, views, budget.growth, run.count)
    scenes = saving_state(optimised(scene, feedback, examples, choose), run.count)
    last = run.take(scene, scenes, progress)
    return Repaired(scene=last, steps=run.count, seconds=run.seconds, interrupted=run.interrupted)


@dataclass
class OptimisationRun:
    """The steps of an optimisation within a budget, counted and timed."""

    budget: RepairBudget
    count: int = 0
    done: float = 0.0
    """Spent share of the budget; 1 or more at the end."""
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
        """Take steps until the budget is spent, or Ctrl-C. Returns the scene after the last step.

        Args:
            scene: the scene before the first step.
            scenes: the scene after each step, endless.
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
    """Views and renders of the dense scene, endless; the first ``taken`` are skipped.

    Numbers of sampled views and of pixels grow with ``growth``, as the steps do: a large scene has
    more Gaussians between the pixels, and its projection takes most of the time. The last 256
    renders are cached, fewer if they are larger.
    """
    count = round(growth * VIEW_COUNTS.stepped)
    side = round(math.sqrt(growth) * SMALLEST_SIDE)
    # 256 renders of 16:9 take 0.2 GB.
    drawn = functools.lru_cache(maxsize=round(256 / growth))(render_of)
    others = itertools.islice(views.others(count=count, drawn_side=side), taken, None)
    return (functools.partial(drawn, dense, view) for view in others)


def initial_rate_factor(psnr: float) -> float:
    """Factor on all learning rates, from the PSNR of the scene before repair, dB: 1 up to
    ``REPAIR.nearly_right``, then proportional to the root mean square error.

    Example:
        >>> [round(initial_rate_factor(psnr), 3) for psnr in (20, 35, 41, 55)]
        [1.0, 1.0, 0.501, 0.1]
    """
    return min(1.0, 10 ** ((REPAIR.nearly_right - psnr) / 20))
