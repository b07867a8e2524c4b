"""Length of a repair: steps by effort, or seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal

from pointsplat_ns.errors import PointSplatError

Effort = Literal["instant", "quick", "thorough"]

STEPS: dict[Effort, int] = {"instant": 0, "quick": 192, "thorough": 1200}
"""Repair steps by effort, for at most :data:`FEW_GAUSSIANS` Gaussians."""

FEW_GAUSSIANS = 20_000
"""Number of Gaussians above which a repair takes more steps, in more views."""

PHOTO_STEPS: dict[Effort, int] = {"instant": 0, "quick": 2400, "thorough": 12000}
"""Training steps on photos by effort."""


@dataclass(frozen=True)
class RepairBudget:
    """Length of a repair, in steps or seconds. Raises PointSplatError if the effort is not one of
    :data:`STEPS`, or the time is negative or infinite."""

    effort: Effort = "quick"
    """Name of a number of steps, see :data:`STEPS`. The result does not depend on the machine's
    speed."""
    seconds: float | None = None
    """Wall-clock time in place of ``effort``. The result depends on the machine's speed."""
    growth: float = 1.0
    """Factor on the numbers of steps and sampled views."""
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

        Steps grow with the square root of the count, up to a factor of four: a view of a large
        scene shows more Gaussians, but a smaller share of them. Beyond that, fewer steps show a
        Gaussian, which moves equally far in each, so learning rates fall instead.

        Example:
            >>> counts = (5_000, 80_000, 320_000, 3_200_000)
            >>> budgets = [RepairBudget().for_count(count) for count in counts]
            >>> [(budget.growth, budget.rate) for budget in budgets]
            [(1.0, 1.0), (2.0, 1.0), (4.0, 1.0), (4.0, 0.1)]
        """
        most = 4.0
        growth = min(max(math.sqrt(count / FEW_GAUSSIANS), 1.0), most)
        return replace(self, growth=growth, rate=min(1.0, most**2 * FEW_GAUSSIANS / count))

    @property
    def empty(self) -> bool:
        """Whether the budget has no step."""
        return self.seconds == 0 if self.seconds is not None else self.steps == 0

    def share_done(self, steps: int, seconds: float) -> float:
        """Spent share of the budget after ``steps`` steps and ``seconds`` seconds; 1 or more at the
        end. The budget must not be empty."""
        return seconds / self.seconds if self.seconds is not None else steps / self.steps


@dataclass(frozen=True)
class PhotoBudget(RepairBudget):
    """Length of the training on photos."""

    @property
    def steps(self) -> int:
        """Number of steps of the effort."""
        return PHOTO_STEPS[self.effort]
