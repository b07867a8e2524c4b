"""Text on a compacted scene: the gains of refinement and repair, or the reasons to leave them out."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pointsplat_ns.compression.acceptance import ACCEPTANCE, Reason, closer_in
from pointsplat_ns.looking.closeness import Closeness

if TYPE_CHECKING:
    from pointsplat_ns.compression.compact import Compacted, Stage

_REASONS = {
    Reason.NO_GAIN: "it does not help",
    Reason.SMALL_GAIN: f"it brings less than {ACCEPTANCE.min_gain:g} dB",
    Reason.MOST_VIEWS: "it is farther in most views",
    Reason.OTHER_SIZES: "it harms pictures of another size",
}


def verdict_of(result: Compacted) -> str:
    """One line of text for each stage after pruning; one line if there are no such stages."""
    lines = [_line(stage, result) for stage in result.stages[1:]]
    if lines:
        return "\n".join(lines)
    if result.before is None:
        return f"not refined or repaired: {_uncompared(result)}"
    return f"not repaired: {result.before.psnr:.2f} dB against the dense scene's renders in {result.before.where}"


def _line(stage: Stage, result: Compacted) -> str:
    noun, before, after = "refinement" if stage.name == "refine" else "repair", stage.before, stage.after
    if stage.reason is Reason.NOT_FINITE:
        unsound = int((result.pruned.usable() & ~stage.scene.usable()).sum())
        return f"{noun} left out: {unsound:,} of {len(stage.scene):,} refined Gaussians are not finite"
    if before is None or after is None:
        return f"{noun} left out: {_uncompared(result)}"
    figures = _figures(before, after)
    cost = f"{stage.steps} steps in {stage.seconds:.1f} s" + (", interrupted" if stage.interrupted else "")
    if stage.reason is None:
        share = "" if stage.strength == 1 else f" at {stage.strength:.0%} of its strength"
        spent = f", {cost}" if stage.name == "repair" else ""
        return f"{noun}{share}{spent}: {figures}"
    if stage.name == "refine" and after.errors == before.errors:
        return f"{noun} left out: it changes nothing, {before.psnr:.2f} dB in {before.where}"
    return (
        f"{noun} left out, {_REASONS[stage.reason]}" + (f" ({cost})" if stage.name == "repair" else "") + f": {figures}"
    )


def _uncompared(result: Compacted) -> str:
    return f"it cannot be compared with the dense scene ({result.uncompared})"


def _figures(before: Closeness, after: Closeness) -> str:
    """Text with the errors before and after."""
    figures = f"{before.psnr:.2f} -> {after.psnr:.2f} dB against the dense scene's renders in {before.where}"
    if before.ssim is not None and after.ssim is not None:
        figures += f", SSIM {before.ssim:.3f} -> {after.ssim:.3f}"
    worst = f"worst view {before.worst:.2f} -> {after.worst:.2f} dB"
    return f"{figures}, {worst}, closer in {closer_in(before, after)} of {len(before.errors)}"
