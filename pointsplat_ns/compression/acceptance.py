"""How much of a change to a smaller scene is kept: as much as brings renders closer to the dense scene's.

A refinement or repair is compared with the scene that it started from. It is kept if it gains in whole pictures of a
middle size, comes closer in at least half of the views, and harms no picture of another size. Changes tend to have the
right direction but to be too large. So half of a change is tried as well, and the share at the minimum of the parabola
through the errors at 0, 1/2 and 1, where the error is least if renders change linearly with the parameters.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from enum import Enum, auto

import torch

from pointsplat_ns.compression.closeness import Closeness, DenseReference
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.looking.windows import WindowRenders, sides_of
from pointsplat_ns.pruning.merging.finishing import top_of_parabola
from pointsplat_ns.system.progress import Progress, silent


@dataclass(frozen=True)
class AcceptanceSettings:
    """When a change is kept."""

    min_gain: float = 0.1
    """Least gain of PSNR, in dB: the sign of a smaller gain depends on the views."""
    most_loss: float = 0.05
    """Largest loss of PSNR, in dB, in pictures of another size."""
    nearer: int = 2
    """Factor on the full size of pictures at which a change is checked too: it stands for nearer cameras."""
    clear_gain: float = 0.5
    """Gain of PSNR, in dB, from which on no share of a change is tried in place of the whole."""
    apart: float = 0.05
    """Least distance of the share at the parabola's minimum from 0, 1/2 and 1, for it to be tried: closer ones hardly
    differ."""


ACCEPTANCE = AcceptanceSettings()


class Reason(Enum):
    """Why a change is left out."""

    NO_GAIN = auto()
    """PSNR does not rise."""
    SMALL_GAIN = auto()
    """PSNR rises by less than :attr:`AcceptanceSettings.min_gain`."""
    MOST_VIEWS = auto()
    """It is farther from the dense scene in most views."""
    OTHER_SIZES = auto()
    """It harms pictures of another size."""
    NOT_FINITE = auto()
    """Some of the changed Gaussians are not finite."""
    NOT_COMPARED = auto()
    """There are no views to compare renders in."""


class Comparison:
    """Compares scenes with the dense one: in whole pictures of a middle size, and in windows of the smallest size, the
    full size, and a larger one that stands for nearer places.

    Args:
        dense: N Gaussians, on the device that renders.
        views: where views come from.

    Raises:
        DataError: if there are no views.
    """

    def __init__(self, dense: Gaussians, views: ViewSource):
        self.reference = DenseReference(dense, views.compared())
        self.device = dense.device
        whole = views.whole()
        sides = sides_of(whole.width, whole.height)
        others = (sides[0], sides[-1], ACCEPTANCE.nearer * sides[-1])
        self._others = WindowRenders(dense, whole, others) if len(sides) > 1 else None

    def psnrs(self, scene: Gaussians) -> list[float]:
        """PSNR of a scene in the windows of each size, dB; empty where pictures are no larger than a window."""
        return [] if self._others is None else self._others.psnrs(scene)


@dataclass(frozen=True, eq=False)
class Change:
    """As much of a refinement or repair as helps."""

    scene: Gaussians
    """The scene with it; the one before, if nothing of it helps."""
    strength: float
    """Share of the change, in (0, 1]; 1 if nothing of it helps."""
    closeness: Closeness
    """Errors of ``scene``; of the whole change, if nothing of it helps."""
    reason: Reason | None
    """Why nothing of it is kept; None if it helps."""


def as_far_as_it_helps(
    judge: Comparison, before: Closeness, old: Gaussians, new: Gaussians, progress: Progress = silent
) -> Change:
    """The best share of a refinement or repair that helps; a scene on the device of ``old``.

    Args:
        judge: what compares.
        before: errors of ``old``.
        old, new: the scenes before and after.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].
    """
    start, end = old.to(judge.device), new.to(judge.device)
    tried: dict[float, Closeness] = {}

    @functools.cache
    def least() -> list[float]:
        """PSNR that a share must reach in pictures of other sizes, dB; rendered only if a share helps at all."""
        return [psnr - ACCEPTANCE.most_loss for psnr in judge.psnrs(start)]

    def attempt(strength: float) -> bool:
        """Whether a share of the change helps."""
        done = len(tried)
        scene = at_strength(start, end, strength)
        tried[strength] = judge.reference.closeness(
            scene, lambda share: progress("comparing renders", (done + share) / 3)
        )
        if not helps(before, tried[strength]):
            return False
        return all(psnr >= bound for bound, psnr in zip(least(), judge.psnrs(scene), strict=True))

    helping = [1.0] if attempt(1.0) else []
    if tried[1.0].errors != before.errors and (not helping or tried[1.0].psnr < before.psnr + ACCEPTANCE.clear_gain):
        helping += [0.5] if attempt(0.5) else []
        bottom = bottom_of_parabola(before.error, tried[0.5].error, tried[1.0].error)
        if all(abs(bottom - share) > ACCEPTANCE.apart for share in (0.0, 0.5, 1.0)):
            helping += [bottom] if attempt(bottom) else []
    progress("comparing renders", 1.0)
    if not helping:
        return Change(old, 1.0, tried[1.0], _reason(before, tried[1.0]))
    strength = min(helping, key=lambda share: tried[share].error)
    return Change(at_strength(start, end, strength).to(old.device), strength, tried[strength], None)


def at_strength(before: Gaussians, after: Gaussians, strength: float) -> Gaussians:
    """The linear interpolation between two scenes, at ``strength`` in [0, 1], of the parameters as stored (log-scales,
    logits). A value that is infinite in one of them stays as in ``before``."""
    if strength == 1:
        return after
    mixed = (a.lerp(b, strength) for a, b in zip(before.tensors(), after.tensors(), strict=True))
    values = zip(before.items(), mixed, strict=True)
    return Gaussians(**{name: torch.where(value.isfinite(), value, a) for (name, a), value in values})


def bottom_of_parabola(at_zero: float, at_half: float, at_one: float) -> float:
    """The position in [0, 1] where the parabola through values at 0, 1/2 and 1 is least; NaN if one is not finite.

    Example:
        >>> round(bottom_of_parabola(0.3**2, 0.2**2, 0.7**2), 6)
        0.3
    """
    if not all(map(math.isfinite, (at_zero, at_half, at_one))):
        return math.nan
    return top_of_parabola((0.0, 0.5, 1.0), [-at_zero, -at_half, -at_one], 0.0)


def helps(before: Closeness, after: Closeness) -> bool:
    """Whether a change is worth keeping: it gains :attr:`AcceptanceSettings.min_gain`, and is closer in at least half
    of the views, as a gain over all pixels may be that of a few views, paid for by the others."""
    return _gains(before, after) and 2 * closer_in(before, after) >= len(before.errors)


def closer_in(before: Closeness, after: Closeness) -> int:
    """Number of views in which a scene has come closer."""
    return sum(new < old for new, old in zip(after.errors, before.errors, strict=True))


def _gains(before: Closeness, after: Closeness) -> bool:
    return after.psnr >= before.psnr + ACCEPTANCE.min_gain and math.isfinite(before.psnr)


def _reason(before: Closeness, after: Closeness) -> Reason:
    """Why a change that brought these errors is left out."""
    if helps(before, after):
        return Reason.OTHER_SIZES
    if _gains(before, after):
        return Reason.MOST_VIEWS
    return Reason.NO_GAIN if after.psnr <= before.psnr else Reason.SMALL_GAIN
