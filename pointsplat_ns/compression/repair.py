"""Repairs a smaller scene by what it can see: steps of Adam against the dense scene's own renders, from fresh views."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch

from pointsplat_ns.compression.optimiser import RATES, Optimiser
from pointsplat_ns.compression.view_source import ViewSource
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import render

Effort = Literal["instant", "quick", "thorough"]

STEPS: dict[Effort, int] = {"instant": 0, "quick": 32, "thorough": 400}
"""Steps of each effort. Those of "quick" take about as long as merging 100,000 to a million Gaussians."""

FASTER = 8.0
"""Factor on the learning rates of 3DGS, which suit 30,000 steps."""

DAMPING = 0.5
"""See :class:`Optimiser`. Half the rates without it gain as much where a scene is wrong, but disturb what was right."""

BETAS = (0.8, 0.98)
"""Decays of Adam's averages: shorter than usual, as there are few steps."""

LAST_SHARE = 0.02
"""Share of the learning rates at the last step; they fall as a cosine."""


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
) -> Repaired:
    """Optimise a smaller scene against renders of the dense one; its number of Gaussians does not change.

    Each step renders both from a view and takes one step of Adam (:class:`Optimiser`). The views are none of those that
    results are compared in, and come from :meth:`ViewSource.others`: no sampled view comes twice, so that there is none
    to overfit. Ctrl-C ends the repair; what has been reached is returned.

    Args:
        scene: K Gaussians; not changed.
        dense: N Gaussians on the same device.
        views: where views come from.
        budget: how long.
        progress: called with the share done, in [0, 1].

    Raises:
        DataError: if there is no place to look from.
    """
    start = time.perf_counter()
    optimiser = Optimiser(scene, {name: FASTER * rate for name, rate in RATES.items()}, BETAS, DAMPING)
    examples = views.others()
    steps, done, interrupted = 0, 0.0, False
    try:
        while done < 1 and not budget.empty:
            view = next(examples)
            with torch.no_grad():
                target = render(dense, view)
            optimiser.step(view, target, LAST_SHARE + (1 - LAST_SHARE) * 0.5 * (1 + math.cos(math.pi * done)))
            steps += 1
            done = budget.share_done(steps, time.perf_counter() - start)
            if progress is not None:
                progress(min(done, 1.0))
    except KeyboardInterrupt:
        interrupted = True
    return Repaired(optimiser.scene, steps, time.perf_counter() - start, interrupted)
