"""The result of compaction: the scene and figures of every stage, and text on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pointsplat_ns.comparing.closeness import Closeness, DenseReference
from pointsplat_ns.compression.acceptance import ACCEPTANCE, Reason, closer_in
from pointsplat_ns.compression.photo_repair import PhotoRepaired
from pointsplat_ns.compression.quality import Judge, PhotoGain
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Stage:
    """One stage of compaction: its scene and its figures."""

    name: Literal["merge", "prune", "refine", "repair", "photos", "round"]
    scene: Gaussians
    """The scene after the stage."""
    after: Closeness | None
    """Errors of ``scene`` against the dense scene's renders; None if it was not compared."""
    before: Closeness | None = None
    """Errors of the scene before the stage; None for pruning."""
    reason: Reason | None = None
    """Why the stage is left out; None if it is kept."""
    steps: int = 0
    """Number of steps of a repair."""
    seconds: float = 0.0
    """Duration of a repair."""
    interrupted: bool = False
    """Whether Ctrl-C ended a repair early."""
    photos: PhotoRepaired | None = None
    """Figures of optimising against photos."""

    @property
    def accepted(self) -> bool:
        """Whether the stage is kept."""
        return self.reason is None


@dataclass(frozen=True, eq=False)
class Compacted:
    """The result of :func:`pointsplat_ns.compact`: a smaller scene, and figures of every stage.

    Example:
        >>> import pointsplat_ns as ps
        >>> result = ps.compact(ps.example_room()[::10], keep="20%", effort="instant")
        >>> result.scene is (result.refined if result.accepted else result.pruned)
        True
    """

    stages: tuple[Stage, ...]
    """Pruning, then refinement, repair and rounding where they were tried. Scenes are on the dense scene's device."""
    notes: tuple[str, ...]
    """Lines of text: SH bands dropped, PSNR reached, origin of the views."""
    reference: DenseReference | None
    """Renders of the dense scene, for comparison with each stage; None if there are no views."""
    seconds: float
    """Total duration."""
    uncompared: str = ""
    """Why there are no views to compare renders in; empty if there are."""
    target: str = ""
    """Text on the search for a PSNR: what was reached, and its cost; empty if there was no search."""
    judge: Judge | None = None
    """The judge of a search for a PSNR; None if there was no search."""
    interrupted: bool = False
    """Whether Ctrl-C ended the repair or the search for a PSNR early."""

    def _stage(self, name: str) -> Stage | None:
        return next((stage for stage in self.stages if stage.name == name), None)

    @property
    def last(self) -> Stage:
        """The last stage that was kept."""
        return last_kept(self.stages)

    @property
    def scene(self) -> Gaussians:
        """The result: the scene after the last stage that was kept."""
        return self.last.scene

    @property
    def pruned(self) -> Gaussians:
        """The scene before refinement."""
        return self.stages[0].scene

    @property
    def refined(self) -> Gaussians:
        """The scene after refinement; ``pruned`` if there is no refiner."""
        return (self._stage("refine") or self.stages[0]).scene

    @property
    def accepted(self) -> bool:
        """Whether the refinement was kept."""
        refined = self._stage("refine")
        return refined is not None and refined.accepted

    @property
    def repaired(self) -> Stage | None:
        """The repair; None if there was none."""
        return self._stage("repair")

    @property
    def repair_accepted(self) -> bool:
        """Whether the repair was kept."""
        return self.repaired is not None and self.repaired.accepted

    @property
    def photo_gain(self) -> PhotoGain | None:
        """What training on photos brought; None if there was none."""
        stage = self._stage("photos")
        if stage is None or stage.photos is None:
            return None
        return PhotoGain(stage.photos.before, stage.photos.after, stage.photos.compared, stage.accepted)

    @property
    def before(self) -> Closeness | None:
        """Errors of ``pruned`` against the reference; None if there are no views."""
        return self.stages[0].after

    @property
    def after(self) -> Closeness | None:
        """Errors of ``refined`` against the reference; None if it was not compared."""
        refined = self._stage("refine")
        return None if refined is None else refined.after

    @property
    def psnr(self) -> float | None:
        """PSNR of ``scene`` against the dense scene's renders over the pixels that the dense scene covers, dB; None if
        nothing was compared."""
        return None if self.last.after is None else self.last.after.psnr

    @property
    def views(self) -> Views | None:
        """The views that renders were compared in."""
        return None if self.reference is None else self.reference.views

    @property
    def verdict(self) -> str:
        """A line of text for each stage after pruning: its gain, or the reason to leave it out. One line if there is no
        such stage."""
        lines = [_line(stage, self) for stage in self.stages[1:]]
        if lines:
            return "\n".join(lines)
        if self.before is None:
            return f"not refined or repaired: {_uncompared(self)}"
        return f"not repaired: {self.before.psnr:.1f} dB PSNR against the dense scene ({self.before.where})"


def last_kept(stages: Sequence[Stage]) -> Stage:
    """The last stage that was kept."""
    return next(stage for stage in reversed(stages) if stage.accepted)


def _line(stage: Stage, result: Compacted) -> str:
    if stage.photos is not None:
        return _photo_line(stage, stage.photos)
    if stage.name == "round":
        figures = "" if stage.before is None or stage.after is None else f": {_figures(stage.before, stage.after)}"
        return f"rounded for the size of the file{figures}"
    done = "refined by the network" if stage.name == "refine" else "repaired"
    before, after = stage.before, stage.after
    if stage.reason is Reason.NOT_FINITE:
        unsound = int((result.pruned.usable() & ~stage.scene.usable()).sum())
        return f"not {done}: {unsound:,} of {len(stage.scene):,} refined Gaussians are not finite"
    if before is None or after is None:
        return f"not {done}: {_uncompared(result)}"
    figures = _figures(before, after)
    steps = "1 step" if stage.steps == 1 else f"{stage.steps} steps"
    cost = f" by {steps} in {stage.seconds:.1f} s" + (", interrupted" if stage.interrupted else "")
    cost = cost if stage.name == "repair" else ""
    if stage.reason is None:
        return f"{done}{cost}: {figures}"
    reasons = {
        Reason.NO_GAIN: "it does not help",
        Reason.SMALL_GAIN: f"it {_TOO_LITTLE}",
        Reason.MOST_VIEWS: "it is farther in most views",
        Reason.OTHER_SIZES: "it harms pictures of another size",
    }
    if stage.name == "refine" and after.errors == before.errors:
        return f"not {done}, it changes nothing: {before.psnr:.1f} dB PSNR against the dense scene ({before.where})"
    return f"not {done}{cost}, {reasons[stage.reason]}: {figures}"


_TOO_LITTLE = f"brings less than {ACCEPTANCE.min_gain:g} dB"


def _photo_line(stage: Stage, trained: PhotoRepaired) -> str:
    cost = f"on {trained.used} photos by {trained.steps} steps in {trained.seconds:.1f} s"
    cost += ", interrupted" if trained.interrupted else ""
    gain = f"{trained.before:.1f} -> {trained.after:.1f} dB PSNR in {trained.compared} photos"
    if stage.accepted:
        return f"trained {cost}: {gain}"
    why = f"other photos lose {trained.lost:.1f} dB" if stage.reason is Reason.NO_GAIN else f"it {_TOO_LITTLE}"
    return f"not trained {cost}, {why}: {gain}"


def _uncompared(result: Compacted) -> str:
    return f"it cannot be compared with the dense scene ({result.uncompared})"


def _figures(before: Closeness, after: Closeness) -> str:
    """Text with the errors before and after."""
    gain = f"{before.psnr:.1f} -> {after.psnr:.1f} dB PSNR against the dense scene"
    worst = f"worst {before.worst:.1f} -> {after.worst:.1f} dB, better in {closer_in(before, after)}"
    return f"{gain} ({before.where}; {worst})"
