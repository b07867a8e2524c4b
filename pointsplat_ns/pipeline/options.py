"""Requests: all options of pruning or of compacting in one object, checked before a scene is
read."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import torch

from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.pruning import (
    Keep,
    Method,
    PruneSettings,
    found_by_trying,
    method_named,
    parse_keep,
    resolve_keep,
)
from pointsplat_ns.scene.gaussians import PLAIN, Gaussians, Traits

if TYPE_CHECKING:
    from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner

Effort = Literal["instant", "quick", "thorough"]

STEPS: dict[Effort, int] = {"instant": 0, "quick": 192, "thorough": 1200}
"""Number of repair steps of each effort, for at most :data:`FEW` Gaussians."""

FEW = 20_000
"""Number of Gaussians above which a repair takes more steps, in more views."""


PHOTO_STEPS: dict[Effort, int] = {"instant": 0, "quick": 2400, "thorough": 12000}
"""Number of steps on photos of each effort."""


def default_device() -> torch.device:
    """CUDA if available, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


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
        """The budget for a scene of ``count`` Gaussians. Steps grow with the root of the count, to
        four times as many: a view shows more Gaussians of a large scene, and a smaller share of
        them. Of still more Gaussians, each is seen in fewer steps, and moves as far in each,
        whatever the pixel: so the learning rates fall.

        Example:
            >>> budgets = [RepairBudget().for_count(count) for count in (5_000, 80_000, 320_000, 3_200_000)]
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
    """Length of the optimisation against photos."""

    @property
    def steps(self) -> int:
        """Number of steps of the effort."""
        return PHOTO_STEPS[self.effort]


@dataclass(frozen=True)
class PruneRequest:
    """Options of pruning.

    Raises:
        BudgetError: if ``keep`` is not a budget.
        PointSplatError: if the method is unknown, or an option does not fit it.

    Example:
        >>> PruneRequest("30%", sh="1").count_of(1000, sh_degree=1)
        300
    """

    keep: Keep | str
    """Ratio, count, size of the file, or PSNR of renders against those of the dense scene."""
    by: str = "merge"
    """One of :data:`~pointsplat_ns.pruning.METHODS`."""
    sh: str = "all"
    """"all" keeps the SH bands, a digit cuts them to that degree, "auto" cuts them to the lowest
    degree whose renders reach 40 dB against those with all bands."""
    opacity_weight: float | None = None
    """Lambda of the methods that weigh opacity; None is the paper's value."""
    clean: bool = False
    """Whether to remove Gaussians that no picture needs first
    (:mod:`~pointsplat_ns.pipeline.cleaning`). ``keep`` still refers to the dense scene, and the
    result has exactly that number of Gaussians."""
    suffix: str = ".ply"
    """Suffix of the format of the result. A size or a PSNR in the text ``keep`` is for it, if it
    names none."""
    budget: Keep = field(init=False)
    """``keep``, parsed if it is text."""
    method: Method = field(init=False)
    """The method called ``by``."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "method", method_named(self.by, self.opacity_weight))
        if self.sh not in ("all", "auto", "0", "1", "2", "3"):
            raise PointSplatError(f"sh is {self.sh!r}; expected all, auto or a degree from 0 to 3")
        budget = parse_keep(self.keep, self.suffix) if isinstance(self.keep, str) else self.keep
        object.__setattr__(self, "budget", budget)

    def count_of(self, n: int, sh_degree: int, traits: Traits = PLAIN) -> int | None:
        """Number of Gaussians to keep of ``n``, which depends on the SH degree and traits of the
        result where it has to fit a file; None if it needs a search (a PSNR, or the size of a
        compressed file). Raises BudgetError if the budget does not fit the scene."""
        return (
            None
            if found_by_trying(self.budget)
            else resolve_keep(n, self.budget, sh_degree, traits)
        )


@dataclass(frozen=True, eq=False)
class CompactRequest:
    """Options of compacting: prune a scene, refine it if there is a refiner, and repair it."""

    prune: PruneRequest
    refiner: TrainedRefiner | None = None
    """None for no refinement."""
    repair: RepairBudget = RepairBudget("instant")
    """Length of the repair."""
    photos: PhotoBudget | None = None
    """Length of the optimisation against photos; None for none."""
    target_db: float | None = None
    """Least PSNR of the file against the dense scene's renders, dB, in place of the budget; None
    for none."""
    most_lost: float | None = None
    """Largest loss of PSNR of the file in held-out photos, dB, in place of the budget; None for
    none."""
    unfinished: Path | None = None
    """The file of :func:`~pointsplat_ns.pipeline.repair.repair`'s state; None for none."""

    @classmethod
    def of(
        cls,
        refiner: TrainedRefiner | None = None,
        keep: Keep | str | None = None,
        by: str | None = None,
        sh: str = "all",
        clean: bool = False,
        repair: RepairBudget = RepairBudget("instant"),
        photos: bool = False,
        suffix: str = ".ply",
        target_db: float | None = None,
    ) -> CompactRequest:
        """A request from options that may be missing: ``keep`` and ``by`` are then those of the
        refiner's training; without a refiner, a tenth and merging. With ``photos``, a number of
        seconds is for the steps on photos, the repair is quick, and ``keep="auto"`` is the smallest
        file that loses at most 0.3 dB in held-out photos. Errors are those of
        :class:`PruneRequest`, or a BudgetError if the target is not a positive number, or given
        with a budget or photos."""
        if target_db is not None and not 0 < target_db < math.inf:
            raise BudgetError(
                f"--target-db is {target_db:g}; expected a positive number, such as 32"
            )
        if target_db is not None and (photos or keep is not None):
            other = "photos, which may differ from renders" if photos else "a budget"
            raise BudgetError(
                "--target-db finds a size by renders of the dense scene; expected it without "
                f"{other}"
            )
        usual = PruneSettings(0.1, "merge") if refiner is None else refiner.settings
        by = usual.by if by is None else by
        most_lost = 0.3 if photos and keep == "auto" else None
        keep = None if most_lost else keep
        weight = usual.opacity_weight if method_named(by).weighs_opacity else None
        prune = PruneRequest(usual.keep if keep is None else keep, by, sh, weight, clean, suffix)
        if not photos:
            return cls(prune, refiner, repair, target_db=target_db)
        trained = PhotoBudget(repair.effort, repair.seconds)
        repair = repair if repair.seconds is None else RepairBudget()
        return cls(prune, refiner, repair, trained, most_lost=most_lost)

    @property
    def device(self) -> torch.device:
        """The device that renders: the refiner's, or the default one."""
        return default_device() if self.refiner is None else self.refiner.device

    @property
    def searched(self) -> bool:
        """Whether the count is searched for that reaches a quality after all stages."""
        return self.target_db is not None or self.most_lost is not None

    def check_sh_degree(self, dense: Gaussians) -> None:
        """Raise a SceneError, before the long computations, if the SH degree after pruning is
        certain to exceed the refiner's."""
        if self.refiner is None:
            return
        sh = self.prune.sh
        limit = self.refiner.network.config.sh_degree
        if dense.sh_degree > limit and (sh == "all" or (sh.isdigit() and int(sh) > limit)):
            raise SceneError(
                f"the scene has SH degree {dense.sh_degree}; the refiner {self.refiner.source} was "
                f"built for at most {limit}; cut it with --sh {limit}"
            )
