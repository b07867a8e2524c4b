"""What a refiner gains in scenes that it was trained on and in others, in one sentence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from pointsplat_ns.pruning import PruneSettings, method_named
from pointsplat_ns.pruning.paper import DEFAULT_OPACITY_WEIGHT

NOTICEABLE = 0.1
"""Gain from which on a refiner helps, dB; the means of a few views are not known better."""

TRANSFERRED = 0.5
"""Share of the gain in its own scenes that a refiner that has learned from enough scenes reaches in
others."""


@dataclass(frozen=True)
class SceneGain:
    """PSNR of one scene before and after the refiner."""

    name: str
    trained_on: bool
    views: int
    pruned: float
    """PSNR of the pruned scene, mean over the views, dB."""
    refined: float
    """The same of the refined scene."""

    @property
    def gain(self) -> float:
        """What refining gains, dB."""
        return self.refined - self.pruned


def mean_gain(gains: Sequence[SceneGain]) -> float | None:
    """Mean gain over scenes, dB; None for no scene."""
    return fmean(scene.gain for scene in gains) if gains else None


def split_gains(gains: Sequence[SceneGain]) -> tuple[list[SceneGain], list[SceneGain]]:
    """The scenes that were trained on, and the others."""
    return [s for s in gains if s.trained_on], [s for s in gains if not s.trained_on]


def gains_line(gains: Sequence[SceneGain]) -> str:
    """Mean PSNR before and after, of the scenes trained on and of the others."""
    own, others = split_gains(gains)
    parts: list[str] = []
    for scenes, name in ((own, ""), (others, "scenes not trained on ")):
        if scenes:
            before = fmean(scene.pruned for scene in scenes)
            after = fmean(scene.refined for scene in scenes)
            first = not parts
            words = (
                f"pruned {before:.1f} -> refined {after:.1f} dB"
                if first
                else (f"{before:.1f} -> {after:.1f}")
            )
            parts.append(name + words)
    return "; ".join(parts)


def verdict(gains: Sequence[SceneGain]) -> str:
    """The sentence on what was gained where, and what would gain more; empty for no scene."""
    own, others = (mean_gain(scenes) for scenes in split_gains(gains))
    if own is None:
        return "" if others is None else f"{_said(others)} in scenes that it was not trained on"
    text = f"{_said(own)} in its own scenes"
    if others is None:
        hold_out = (
            "hold one out (--pipeline.datamanager.eval-scenes NAME) to see what it gains in others"
        )
        return (
            f"{text}; no scene was held out: {hold_out}"
            if own > NOTICEABLE
            else (f"{text}: more steps, or higher rates (--rate-factor)")
        )
    same = own > NOTICEABLE and others >= 0.05
    text += f", {f'{others:.1f} dB' if same else _said(others)} in others"
    if own <= NOTICEABLE:
        return f"{text}: more steps, or higher rates (--rate-factor)"
    if others < TRANSFERRED * own:
        return f"{text}: more scenes, not more steps"
    return f"{text}: it carries over; more steps may gain more"


def _said(gain: float) -> str:
    """A gain or a loss in words."""
    if abs(gain) < 0.05:
        return "gains nothing"
    return f"{'gains' if gain > 0 else 'loses'} {abs(gain):.1f} dB"


def keep_text(keep: float | int) -> str:
    """A ratio as a percentage, a count with its unit."""
    return f"{100 * keep:g} %" if isinstance(keep, float) else f"{keep:,} Gaussians"


def selection_text(settings: PruneSettings) -> str:
    """How scenes are pruned, in one line."""
    method = method_named(settings.by)
    words = {
        "paper": "PointSplat's score (eq. 3)",
        "authors": "the score of PointSplat's released code",
        "merge": "merging of neighbours (ours, not the paper's; --pipeline.model.by paper)",
    }.get(settings.by, f"{settings.by} (not the paper's; --pipeline.model.by paper)")
    if method.weighs_opacity:
        weight = settings.opacity_weight
        words += f", lambda {DEFAULT_OPACITY_WEIGHT if weight is None else weight:g}"
    return f"selection: {words}, {keep_text(settings.keep)}"
