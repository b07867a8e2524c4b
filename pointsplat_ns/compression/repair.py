"""Repairs a smaller scene by what it can see: learned steps against the dense scene's own renders, from fresh views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.compression.feedback import MOST_STEPS, Feedback
from pointsplat_ns.compression.optimiser import gradients_of
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.rasterizer import render
from pointsplat_ns.refiner.feedback import FeedbackRefiner, shipped_feedback_refiner
from pointsplat_ns.system.threads import one_thread, suitable_threads

Effort = Literal["instant", "quick", "thorough"]

STEPS: dict[Effort, int] = {"instant": 0, "quick": 48, "thorough": 400}
"""Steps of each effort. Those of "quick" take about as long as merging 100,000 to a million Gaussians."""

NEARLY_RIGHT = 35.0
"""PSNR over what the dense scene covers, in dB, above which the learning rates fall with the root mean square error
that is left, see :func:`share_of_start`. Steps of a size that repairs a tenth of a scene disturb the half of it, which
is nearly right: from 44 dB, half of a kettle gains 1.7 dB at a third of the rates and 0.2 at all of them; from 42 dB,
half of a cake 2.0 and 0.3; from 40 dB, half of a room 1.2, at half of the rates, and nothing. From 36 dB and below all
of the rates gain most: 3.2 dB of half a statue, which fills a third of its pictures, so that over all pixels it has 40
dB. (Tuned on a bouquet, a cake, a kettle, a statue and two rooms.)"""

LAST_SHARE = 0.02
"""Share of the learning rates at the last step, see :func:`share_of_rates`."""


@dataclass(frozen=True)
class RepairBudget:
    """How long to repair.

    Raises:
        PointSplatError: if it is not a positive time or one of :data:`STEPS`.
    """

    effort: Effort = "quick"
    """A number of steps, see :data:`STEPS`: the result is the same however fast the machine is."""
    seconds: float | None = None
    """Wall-clock time, which goes before ``effort``: the result depends on the machine."""

    def __post_init__(self) -> None:
        if self.effort not in STEPS:
            raise PointSplatError(f"effort is {self.effort!r}; expected one of {', '.join(STEPS)}")
        if self.seconds is not None and not 0 <= self.seconds < math.inf:
            raise PointSplatError(f"the time to repair is {self.seconds:g} s; expected 0 or more")

    @property
    def empty(self) -> bool:
        """Whether there is no time for any step."""
        return self.seconds == 0 if self.seconds is not None else STEPS[self.effort] == 0

    def share_done(self, steps: int, seconds: float) -> float:
        """Share of the budget, which must not be empty, that so many steps, which took so long, have used; 1 or more at
        the end."""
        return seconds / self.seconds if self.seconds is not None else steps / STEPS[self.effort]

    def steps_in_all(self, steps: int, done: float) -> int:
        """Number of steps that fit the budget, as far as that can be known when so many steps have used a share
        ``done`` of it."""
        if self.seconds is None:
            return STEPS[self.effort]
        return round(steps / done) if done else MOST_STEPS


@dataclass(frozen=True)
class Repaired:
    """A repaired scene, and what it took."""

    scene: Gaussians
    steps: int
    seconds: float
    interrupted: bool
    """Whether Ctrl-C ended it before its time."""


def repair(
    scene: Gaussians,
    dense: Gaussians,
    views: ViewSource,
    budget: RepairBudget,
    progress: Callable[[float], None] | None = None,
    network: FeedbackRefiner | Literal["shipped"] | None = "shipped",
    psnr: float = 0.0,
) -> Repaired:
    """Optimise a smaller scene against renders of the dense one; its number of Gaussians does not change.

    Each step renders both from a view. A network sees what the gradients of the loss have said of each Gaussian, and
    sets how far it moves (:mod:`~pointsplat_ns.refiner.feedback`). The views are none of
    those that results are compared in, and come from :meth:`ViewSource.others`: no sampled view comes twice, so that
    there is none to overfit. Ctrl-C ends the repair; what has been reached is returned.

    Args:
        scene: K Gaussians; not changed.
        dense: N Gaussians on the same device.
        views: where views come from.
        budget: how long.
        progress: called with the share done, in [0, 1].
        network: on the scene's device; by default the one that ships, None for the steps of Adam.
        psnr: of the scene's renders against the dense one's, over what that covers
            (:meth:`~pointsplat_ns.compression.closeness.DenseReference.psnr_of_covered`), dB: what is nearly right is
            moved by smaller steps.

    Raises:
        DataError: if there is no place to look from.
    """
    start = time.perf_counter()
    if network == "shipped":
        network = shipped_feedback_refiner(scene.device)
    feedback = Feedback(scene, len(dense))
    examples, share = views.others(), share_of_start(psnr)
    steps, done, interrupted = 0, 0.0, False
    try:
        while done < 1 and not budget.empty:
            with suitable_threads(scene.device):
                view = next(examples)
                with torch.no_grad():
                    target = render(dense, view)
                feedback.observe(gradients_of(scene, view, target))
                factors = _factors(network, feedback, scene, done, budget.steps_in_all(steps, done))
                scene = feedback.moved(scene, share * share_of_rates(done), factors)
            steps += 1
            done = budget.share_done(steps, time.perf_counter() - start)
            if progress is not None:
                progress(min(done, 1.0))
    except KeyboardInterrupt:
        interrupted = True
    return Repaired(scene, steps, time.perf_counter() - start, interrupted)


def share_of_rates(done: float) -> float:
    """What is left of the learning rates when a share of the steps, in [0, 1], is done: it falls as a cosine."""
    return LAST_SHARE + (1 - LAST_SHARE) * 0.5 * (1 + math.cos(math.pi * done))


def share_of_start(psnr: float) -> float:
    """Share of the learning rates for a scene of a PSNR, dB: 1 up to :data:`NEARLY_RIGHT`, then what keeps steps in
    proportion to the error.

    Example:
        >>> [round(share_of_start(psnr), 3) for psnr in (20, 35, 41, 55)]
        [1.0, 1.0, 0.501, 0.1]
    """
    return min(1.0, 10 ** ((NEARLY_RIGHT - psnr) / 20))


def _factors(
    network: FeedbackRefiner | None, feedback: Feedback, scene: Gaussians, done: float, steps: int
) -> Tensor | None:
    """Factors of the next step; None without a network."""
    if network is None:
        return None
    with torch.no_grad(), one_thread():  # a small network: shared, its sums would be rounded by the number of threads
        return network(feedback.features(scene, done, steps))
