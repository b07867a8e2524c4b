"""Text on a compacted scene: the gains of refinement and repair, or the reasons to leave them out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pointsplat_ns.compression.acceptance import ACCEPTANCE, Reason, closer_in
from pointsplat_ns.looking.closeness import Closeness

if TYPE_CHECKING:
    from pointsplat_ns.compression.compact import Compacted, Stage
    from pointsplat_ns.compression.photo_repair import PhotoRepaired


def verdict_of(result: Compacted) -> str:
    """One line of text for each stage after pruning; one line if there are no such stages."""
    lines = [_line(stage, result) for stage in result.stages[1:]]
    if lines:
        return "\n".join(lines)
    if result.before is None:
        return f"not refined or repaired: {_uncompared(result)}"
    return f"not repaired: {result.before.psnr:.1f} dB PSNR against the dense scene ({result.before.where})"


def _line(stage: Stage, result: Compacted) -> str:
    if stage.photos is not None:
        return _photo_line(stage.photos, kept=stage.accepted)
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
        share = "" if stage.strength == 1 else f", {stage.strength:.0%} of the change kept"
        return f"{done}{cost}{share}: {figures}"
    reasons = {
        Reason.NO_GAIN: "it does not help",
        Reason.SMALL_GAIN: f"it brings less than {ACCEPTANCE.min_gain:g} dB",
        Reason.MOST_VIEWS: "it is farther in most views",
        Reason.OTHER_SIZES: "it harms pictures of another size",
    }
    if stage.name == "refine" and after.errors == before.errors:
        return f"not {done}, it changes nothing: {before.psnr:.1f} dB PSNR against the dense scene ({before.where})"
    return f"not {done}{cost}, {reasons[stage.reason]}: {figures}"


def _photo_line(trained: PhotoRepaired, kept: bool) -> str:
    cost = f"on {trained.used} photos by {trained.steps} steps in {trained.seconds:.1f} s"
    cost += ", interrupted" if trained.interrupted else ""
    gain = f"{trained.before:.1f} -> {trained.after:.1f} dB PSNR in {trained.compared} photos"
    return f"trained {cost}: {gain}" if kept else f"not trained {cost}, it does not help: {gain}"


def _uncompared(result: Compacted) -> str:
    return f"it cannot be compared with the dense scene ({result.uncompared})"


def _figures(before: Closeness, after: Closeness) -> str:
    """Text with the errors before and after."""
    gain = f"{before.psnr:.1f} -> {after.psnr:.1f} dB PSNR against the dense scene"
    worst = f"worst {before.worst:.1f} -> {after.worst:.1f} dB, closer in {closer_in(before, after)}"
    return f"{gain} ({before.where}; {worst})"
