"""Repairs a smaller scene by what it can see: learned steps against the dense scene's own renders, from fresh views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.compression.feedback import REPAIR, Feedback
from pointsplat_ns.compression.optimiser import optimised
from pointsplat_ns.compression.requests import STEPS, Effort, RepairBudget
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.rasterizer import render
from pointsplat_ns.refiner.feedback import FeedbackRefiner, shipped_feedback_refiner
from pointsplat_ns.system.threads import one_thread
from pointsplat_ns.views import View

__all__ = ["STEPS", "Effort", "RepairBudget", "Repaired", "repair", "share_of_rates", "share_of_start"]


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
    feedback, first_share = Feedback(scene, len(dense)), share_of_start(psnr)
    steps, done, interrupted = 0, 0.0, False

    def choose(scene: Gaussians) -> tuple[float, Tensor | None]:
        factors = None
        if network is not None:
            expected = budget.steps_in_all(steps, done) or REPAIR.most_steps
            with torch.no_grad(), one_thread():  # so small that threads would only change how its sums are rounded
                factors = network(feedback.features(scene, done, expected))
        return first_share * share_of_rates(done), factors

    scenes = optimised(scene, feedback, _examples(dense, views), choose)
    try:
        while done < 1 and not budget.empty:
            scene = next(scenes)
            steps += 1
            done = budget.share_done(steps, time.perf_counter() - start)
            if progress is not None:
                progress(min(done, 1.0))
    except KeyboardInterrupt:
        interrupted = True
    return Repaired(scene, steps, time.perf_counter() - start, interrupted)


def _examples(dense: Gaussians, views: ViewSource) -> Iterator[tuple[View, Tensor]]:
    """Views and renders of the dense scene from them, without end."""
    for view in views.others():
        with torch.no_grad():
            target = render(dense, view)
        yield view, target


def share_of_rates(done: float) -> float:
    """What is left of the learning rates when a share of the steps, in [0, 1], is done: it falls as a cosine."""
    return REPAIR.last_share + (1 - REPAIR.last_share) * 0.5 * (1 + math.cos(math.pi * done))


def share_of_start(psnr: float) -> float:
    """Share of the learning rates for a scene of a PSNR, dB: 1 up to ``REPAIR.nearly_right``, then in proportion to the
    root mean square error.

    Example:
        >>> [round(share_of_start(psnr), 3) for psnr in (20, 35, 41, 55)]
        [1.0, 1.0, 0.501, 0.1]
    """
    return min(1.0, 10 ** ((REPAIR.nearly_right - psnr) / 20))
