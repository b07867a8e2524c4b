"""The stages of compaction after pruning: refinement, repair, training on photos, rounding.

A stage takes the result of the last accepted stage and a :class:`Context`. It returns its own
result: the scene, errors before and after, and the reason to reject it, if any.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from pointsplat_ns.pipeline.acceptance import Comparison
from pointsplat_ns.pipeline.budget_search import FileLimit
from pointsplat_ns.pipeline.photo_repair import PHOTO_REPAIR, PhotoRepaired, photo_repair
from pointsplat_ns.pipeline.photos.examples import Photos
from pointsplat_ns.pipeline.reasons import Cause, Reason
from pointsplat_ns.pipeline.repair import repair
from pointsplat_ns.pipeline.repair_budget import PhotoBudget, RepairBudget
from pointsplat_ns.pipeline.report import StageResult
from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.progress import Progress, silent


@dataclass(frozen=True, eq=False)
class Context:
    """Inputs common to all stages."""

    dense: Gaussians
    """The dense scene, on the device that renders."""
    views: ViewProvider
    comparison: Comparison | None
    """Compares scenes with the dense scene; None if there are no views."""
    uncompared: str = ""
    """Error that prevents the comparison."""
    progress: Progress = silent

    @property
    def reference(self) -> DenseReference | None:
        """Renders of the dense scene; None if there are no views."""
        return None if self.comparison is None else self.comparison.reference


class Stage(Protocol):
    """A change to a scene, which is accepted or rejected."""

    def run(self, last: StageResult, context: Context) -> StageResult:
        """Change the scene of the last accepted stage, and decide whether the change is
        accepted."""


@dataclass(frozen=True, eq=False)
class Refine(Stage):
    """One forward pass of a trained network."""

    refiner: TrainedRefiner
    share: float
    """Number of Gaussians after pruning, as a share of the dense scene's."""

    def run(self, last: StageResult, context: Context) -> StageResult:
        context.progress("refining", 0.0)
        refined = self.refiner(last.scene, self.share)
        not_finite = int((last.scene.usable() & ~refined.usable()).sum())
        if not_finite:
            reason = Reason(Cause.NOT_FINITE, count=not_finite, total=len(refined))
            return StageResult("refine", refined, None, before=last.after, reason=reason)
        if context.comparison is None or last.after is None:
            reason = Reason(Cause.NOT_COMPARED, error=context.uncompared)
            return StageResult("refine", refined, None, reason=reason)
        after, rejection = context.comparison.judge(
            last.after, last.scene, refined, context.progress
        )
        return StageResult("refine", refined, after, before=last.after, reason=rejection)


@dataclass(frozen=True, eq=False)
class Repair(Stage):
    """Steps towards renders of the dense scene."""

    budget: RepairBudget
    state_file: Path | None = None
    """File with the state of a long repair, from which a killed command continues; None for
    none."""

    def applies(self, last: StageResult) -> bool:
        """Whether the scene can be compared, has errors, and the budget is not empty."""
        return last.after is not None and last.after.psnr < math.inf and not self.budget.empty

    def run(self, last: StageResult, context: Context) -> StageResult:
        assert last.after is not None and context.comparison is not None
        context.progress("repairing", 0.0)
        repaired = repair(
            last.scene.to(context.dense.device),
            context.dense,
            context.views,
            self.budget,
            functools.partial(context.progress, "repairing"),
            psnr=last.after.psnr,
            unfinished=self.state_file,
        )
        after, reason = context.comparison.judge(last.after, last.scene, repaired.scene)
        return StageResult(
            stage="repair",
            scene=repaired.scene.to(last.scene.device),
            after=after,
            before=last.after,
            reason=reason,
            steps=repaired.steps,
            seconds=repaired.seconds,
            interrupted=repaired.interrupted,
        )


@dataclass(frozen=True, eq=False)
class TrainOnPhotos(Stage):
    """Training on photos, accepted by its PSNR in photos."""

    photos: Photos
    budget: PhotoBudget

    @staticmethod
    def needs_repair_before(count: int) -> bool:
        """Whether a scene of ``count`` Gaussians is repaired before its training."""
        return count > PHOTO_REPAIR.large

    def run(self, last: StageResult, context: Context) -> StageResult:
        context.progress("training on photos", 0.0)
        trained = photo_repair(
            last.scene.to(context.dense.device),
            context.dense,
            self.photos,
            context.views,
            self.budget,
            functools.partial(context.progress, "training on photos"),
        )
        return self._judged(last, trained, context)

    def against(self, result: StageResult, repaired: StageResult, context: Context) -> StageResult:
        """The result of a training, compared with a repair instead of the scene before training."""
        assert result.photos is not None
        scene = repaired.scene.to(context.dense.device)
        return self._judged(repaired, result.photos.against(scene, self.photos), context)

    def _judged(self, last: StageResult, trained: PhotoRepaired, context: Context) -> StageResult:
        most_lost = PHOTO_REPAIR.most_lost if last.stage == "repair" else 0.0
        reference = context.reference
        return StageResult(
            stage="photos",
            scene=trained.scene.to(last.scene.device),
            after=None if reference is None else reference.closeness(trained.scene),
            before=last.after,
            reason=trained.rejection(most_lost),
            steps=trained.steps,
            seconds=trained.seconds,
            interrupted=trained.interrupted,
            photos=trained,
        )


def rounded(last: StageResult, limit: FileLimit, reference: DenseReference | None) -> StageResult:
    """Round the scene of the last accepted stage for a compressed file. Returns ``last`` if nothing
    is rounded."""
    scene = limit.rounded(last.scene)
    if scene is last.scene:
        return last
    after = None
    if reference is not None:
        after = reference.closeness(scene.to(reference.renders[0].device))
    return StageResult("round", scene, after, before=last.after)
