"""Results of a request in numbers: :class:`Report`, with a :class:`StageResult` per stage."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from pointsplat_ns.pipeline.reasons import Reason
from pointsplat_ns.pipeline.view_provider import ViewOrigin
from pointsplat_ns.rendering.comparison.closeness import Closeness, DenseReference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views

if TYPE_CHECKING:
    from pointsplat_ns.pipeline.cleaning import Cleaning
    from pointsplat_ns.pipeline.photo_repair import PhotoRepaired
    from pointsplat_ns.pipeline.quality import Judge, PhotoGain

StageName = Literal["merge", "prune", "refine", "repair", "photos", "round"]


@dataclass(frozen=True, eq=False)
class StageResult:
    """The result of one stage."""

    stage: StageName
    scene: Gaussians
    """The scene after the stage."""
    after: Closeness | None
    """Errors of ``scene`` against renders of the dense scene; None if not compared."""
    before: Closeness | None = None
    """Errors of the scene before the stage; None for pruning."""
    reason: Reason | None = None
    """Reason to reject the stage; None if it is accepted."""
    steps: int = 0
    """Number of steps of a repair."""
    seconds: float = 0.0
    """Duration of a repair."""
    interrupted: bool = False
    """Whether Ctrl-C ended a repair early."""
    photos: PhotoRepaired | None = None
    """Figures of training on photos."""

    @property
    def accepted(self) -> bool:
        """Whether the stage is part of the result."""
        return self.reason is None


def last_accepted(results: Sequence[StageResult]) -> StageResult:
    """The result of the last accepted stage."""
    return next(result for result in reversed(results) if result.accepted)


@dataclass(frozen=True)
class ShCut:
    """A cut of SH bands."""

    before: int
    """SH degree of the dense scene."""
    after: int
    """SH degree of the result."""
    lost: float = 0.0
    """Lost share of the view-dependent colour, in [0, 1]."""
    psnr: float | None = None
    """PSNR of renders against those with all bands, dB; None if not measured."""


@dataclass(frozen=True)
class PsnrSearch:
    """A search for the smallest scene that reaches a PSNR."""

    tried: int
    """Number of sizes that were tried."""
    psnr: float
    """PSNR of the result against the dense scene, dB."""
    worst: float
    """The same of the worst view, dB."""
    views: int
    """Number of views."""


@dataclass(frozen=True)
class SizeSearch:
    """A search for the largest scene that fits a compressed file."""

    tried: int
    """Number of sizes that were tried."""
    bytes: float
    """Maximum size of the file."""
    format: str
    """Name of the file's format."""


@dataclass(frozen=True)
class TargetSearch:
    """A search for the smallest file that reaches a quality after all stages."""

    psnr: float
    """PSNR of the file, dB: in held-out photos if ``photos`` is above 0, else against the dense
    scene."""
    bytes: int
    """Size of the file."""
    gaussians: int
    photos: int = 0
    """Number of held-out photos to judge by; 0 to judge by renders of the dense scene."""
    dense_psnr: float = 0.0
    """PSNR of the dense scene in the held-out photos, dB."""
    tried: int = 0
    """Number of sizes that were tried."""
    interrupted: bool = False
    """Whether Ctrl-C ended the search early."""


@dataclass(frozen=True)
class HeldOut:
    """PSNR in held-out photos."""

    photos: int
    """Number of photos."""
    psnrs: tuple[float, ...]
    """Mean PSNR of each result, in the order of the stages, dB."""
    dense: float
    """The same of the dense scene, dB."""


@dataclass(frozen=True, eq=False)
class Report:
    """The result of a request: a smaller scene, and figures of every stage."""

    stages: tuple[StageResult, ...]
    """Results of pruning, then of refinement, repair and rounding if they ran. Scenes are on the
    dense scene's device. Empty if the result is only in a file (``written``)."""
    by: str
    """The method of pruning."""
    count_before: int
    """Number of Gaussians of the dense scene."""
    seconds: float
    """Total duration."""
    origin: ViewOrigin | None = None
    """Origin of the views; None if none were needed."""
    sh: ShCut | None = None
    """Cut of SH bands; None if all bands are requested."""
    cleaning: Cleaning | None = None
    """Result of cleaning; None if not requested."""
    search: PsnrSearch | SizeSearch | None = None
    """Search for the count of a budget; None if the budget determines the count."""
    target: TargetSearch | None = None
    """Search for a quality after all stages; None if there was none."""
    reference: DenseReference | None = None
    """Renders of the dense scene for comparison; None if there are no views."""
    uncompared: str = ""
    """Error that prevents comparison of renders; empty if they are compared."""
    judge: Judge | None = None
    """Judge of a search for a quality; None without a search."""
    held_out: HeldOut | None = None
    """PSNR in held-out photos; None if there are none."""
    no_held_out: str = ""
    """Error for which there are no held-out photos; empty if not requested."""
    interrupted: bool = False
    """Whether Ctrl-C ended the repair or a search early."""
    written: Path | None = None
    """File of the result, if the scene was larger than memory."""
    dense: Gaussians | None = field(default=None, repr=False)
    """The dense scene; None if it is larger than memory."""

    def stage(self, name: StageName) -> StageResult | None:
        """The first result of a stage; None if it did not run."""
        return next((result for result in self.stages if result.stage == name), None)

    @property
    def last(self) -> StageResult:
        """The last accepted stage."""
        return last_accepted(self.stages)

    @property
    def scene(self) -> Gaussians:
        """The result: the scene after the last accepted stage."""
        return self.last.scene

    @property
    def pruned(self) -> Gaussians:
        """The scene before refinement and repair."""
        return self.stages[0].scene

    @property
    def accepted(self) -> bool:
        """Whether the refinement was accepted."""
        refined = self.stage("refine")
        return refined is not None and refined.accepted

    @property
    def repaired(self) -> StageResult | None:
        """The repair; None if there was none."""
        return self.stage("repair")

    @property
    def repair_accepted(self) -> bool:
        """Whether the repair was accepted."""
        return self.repaired is not None and self.repaired.accepted

    @property
    def photo_gain(self) -> PhotoGain | None:
        """Gain of training on photos; None if there was none."""
        from pointsplat_ns.pipeline.quality import PhotoGain

        result = self.stage("photos")
        if result is None or result.photos is None:
            return None
        return PhotoGain(
            before=result.photos.before,
            after=result.photos.after,
            photos=result.photos.compared,
            accepted=result.accepted,
        )

    @property
    def before(self) -> Closeness | None:
        """Errors of ``pruned`` against the reference; None if there are no views."""
        return self.stages[0].after

    @property
    def psnr(self) -> float | None:
        """PSNR of ``scene`` against the dense scene, over the pixels that the dense scene covers,
        dB; None if not compared."""
        return None if self.last.after is None else self.last.after.psnr

    @property
    def views(self) -> Views | None:
        """The views in which renders were compared."""
        return None if self.reference is None else self.reference.views
