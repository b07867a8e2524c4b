"""The result of compaction: the scene and figures of every stage, and text on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from pointsplat_ns.pipeline.acceptance import closer_in
from pointsplat_ns.pipeline.photo_repair import PhotoRepaired
from pointsplat_ns.pipeline.quality import Judge, PhotoGain
from pointsplat_ns.rendering.comparison.closeness import Closeness, DenseReference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.quantities import counted


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
    reason: str = ""
    """Why the stage is left out; empty if it is kept."""
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
        return not self.reason

    @property
    def done(self) -> str:
        """What the stage does to a scene, as a participle."""
        return "trained" if self.name == "photos" else f"{self.name.removesuffix('e')}ed"


@dataclass(frozen=True, eq=False)
class Compacted:
    """The result of :func:`pointsplat_ns.compact`: a smaller scene, and figures of every stage.

    Example:
        >>> import pointsplat_ns as ps
        >>> result = ps.compact(ps.example_room()[::10], keep="20%", effort="instant")
        >>> result.scene is result.pruned, result.accepted
        (True, False)
    """

    stages: tuple[Stage, ...]
    """Pruning, then refinement, repair and rounding where they were tried. Scenes are on the dense
    scene's device."""
    notes: tuple[str, ...]
    """Lines of text: SH bands dropped, PSNR reached, origin of the views."""
    reference: DenseReference | None
    """Renders of the dense scene, for comparison with each stage; None if there are no views."""
    seconds: float
    """Total duration."""
    uncompared: str = ""
    """Why renders cannot be compared; empty if they are."""
    target: str = ""
    """Text on the search for a PSNR: what was reached, and its cost; empty if there was no
    search."""
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
        """The scene before refinement and repair."""
        return self.stages[0].scene

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
        return PhotoGain(
            stage.photos.before, stage.photos.after, stage.photos.compared, stage.accepted
        )

    @property
    def before(self) -> Closeness | None:
        """Errors of ``pruned`` against the reference; None if there are no views."""
        return self.stages[0].after

    @property
    def psnr(self) -> float | None:
        """PSNR of ``scene`` against the dense scene's renders over the pixels that the dense scene
        covers, dB; None if nothing was compared."""
        return None if self.last.after is None else self.last.after.psnr

    @property
    def views(self) -> Views | None:
        """The views that renders were compared in."""
        return None if self.reference is None else self.reference.views

    @property
    def verdict(self) -> str:
        """A line of text for each stage after pruning: its gain, or the reason to leave it out. One
        line if there is no such stage."""
        lines = [stage_text(stage) for stage in self.stages[1:]]
        if lines:
            return "\n".join(lines)
        if self.before is None:
            return f"not refined or repaired: {self.uncompared}"
        return (
            f"not repaired: {self.before.psnr:.1f} dB PSNR against the dense scene "
            f"({self.before.where})"
        )


def last_kept(stages: Sequence[Stage]) -> Stage:
    """The last stage that was kept."""
    return next(stage for stage in reversed(stages) if stage.accepted)


def stage_text(stage: Stage) -> str:
    """A line of text: what a stage gains, or the reason to leave it out."""
    cost = (
        f" by {counted(stage.steps, 'step')} in {stage.seconds:.1f} s"
        if stage.name in ("repair", "photos")
        else ""
    )
    cost += ", interrupted" if stage.interrupted else ""
    done = stage.done + {"refine": " by the network", "round": " for the size of the file"}.get(
        stage.name, ""
    )
    if stage.photos is not None:
        done += f" on {stage.photos.used} photos"
        figures = (
            f"{stage.photos.before:.1f} -> {stage.photos.after:.1f} dB PSNR in "
            f"{stage.photos.compared} photos"
        )
    else:
        figures = (
            ""
            if stage.before is None or stage.after is None
            else _figures(stage.before, stage.after)
        )
    reason = (
        f", {stage.reason}" if stage.reason and figures else stage.reason and f": {stage.reason}"
    )
    return f"{'' if stage.accepted else 'not '}{done}{cost}{reason}" + (
        f": {figures}" if figures else ""
    )


def _figures(before: Closeness, after: Closeness) -> str:
    """Text with the errors before and after."""
    gain = f"{before.psnr:.1f} -> {after.psnr:.1f} dB PSNR against the dense scene"
    worst = (
        f"worst {before.worst:.1f} -> {after.worst:.1f} dB, better in {closer_in(before, after)}"
    )
    return f"{gain} ({before.where}; {worst})"
