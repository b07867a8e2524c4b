"""Lengths of repairs: steps by effort, or seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from pointsplat_ns.errors import PointSplatError

Effort = Literal["instant", "quick", "thorough"]

STEPS: dict[Effort, int] = {"instant": 0, "quick": 192, "thorough": 1200}
"""Number of repair steps of each effort, for at most :data:`FEW` Gaussians."""

FEW = 20_000
"""Number of Gaussians above which a repair takes more steps, in more views."""

PHOTO_STEPS: dict[Effort, int] = {"instant": 0, "quick": 2400, "thorough": 12000}
"""Number of training steps on photos of each effort."""


@dataclass(frozen=True)
class RepairBudget:
    """Length of a repair, in steps or seconds. Raises PointSplatError if it is not a positive time
    or one of :data:`STEPS`."""

    effort: Effort = "quick"
    """Number of steps, see :data:`STEPS`. The result does not depend on the speed of the
    machine."""
    seconds: float | None = None
    """Wall-clock time, in place of ``effort``. The result depends on the speed of the machine."""
    growth: float = 1.0
    """Factor on the number of steps, and of sampled views."""
    rate: float = 1.0
    """Factor on the learning rates."""

    def __post_init__(self) -> None:
        if self.effort not in STEPS:
            raise PointSplatError(f"effort is {self.effort!r}; expected one of {', '.join(STEPS)}")
        if self.seconds is not None and not 0 <= self.seconds < math.inf:
            raise PointSplatError(f"the time to repair is {self.seconds:g} s; expected 0 or more")

    @property
    def steps(self) -> int:
        """Number of steps of the effort."""
        return round(self.growth * STEPS[self.effort])

    def for_count(self, count: int) -> RepairBudget:
        """The budget for a scene of ``count`` Gaussians.

        Steps grow with the square root of the count, up to four times as many: a view of a large
        scene shows more Gaussians, and a smaller share of them. Above that, each Gaussian is seen
        in fewer steps and moves equally far in each, whatever the pixel, so learning rates fall.

        Example:
            >>> counts = (5_000, 80_000, 320_000, 3_200_000)
            >>> budgets = [RepairBudget().for_count(count) for count in counts]
            >>> [(budget.growth, budget.rate) for budget in budgets]
            [(1.0, 1.0), (2.0, 1.0), (4.0, 1.0), (4.0, 0.1)]
        """
        most = 4.0
        growth = min(max(math.sqrt(count / FEW), 1.0), most)
        return replace(self, growth=growth, rate=min(1.0, most**2 * FEW / count))

    @property
    def empty(self) -> bool:
        """Whether the budget has no step."""
        return self.seconds == 0 if self.seconds is not None else self.steps == 0

    def share_done(self, steps: int, seconds: float) -> float:
        """Used share of the budget after ``steps`` steps and ``seconds`` seconds; 1 or more at the
        end. The budget must not be empty."""
        return seconds / self.seconds if self.seconds is not None else steps / self.steps


@dataclass(frozen=True)
class PhotoBudget(RepairBudget):
    """Length of the training on photos."""

    @property
    def steps(self) -> int:
        """Number of steps of the effort."""
        return PHOTO_STEPS[self.effort]
