"""Accepts a change to a smaller scene: the share of it that brings renders closest to the dense scene's, or none.

A refinement or repair is compared with the scene that it started from. It is kept if it gains in whole pictures of a
middle size, lowers the error in at least half of the views, and harms no picture of another size. Changes often have
the right direction and too large a length. So two more shares are tried: half of the change, and the minimum of the
parabola through the errors at 0, 1/2 and 1. The error is exactly such a parabola if renders are linear in the
parameters.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from enum import Enum, auto

import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import Closeness, DenseReference
from pointsplat_ns.looking.sizes import RendersOfSizes, sides_of
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.merging.finishing import top_of_parabola
from pointsplat_ns.system.progress import Progress, silent


@dataclass(frozen=True)
class AcceptanceSettings:
    """Thresholds for keeping a change."""

    min_gain: float = 0.1
    """Least gain of PSNR, in dB: the sign of a smaller gain depends on the views."""
    most_loss: float = 0.05
    """Largest loss of PSNR, in dB, in pictures of another size."""


ACCEPTANCE = AcceptanceSettings()


class Reason(Enum):
    """Reason to leave a change out."""

    NO_GAIN = auto()
    """PSNR does not rise."""
    SMALL_GAIN = auto()
    """PSNR rises by less than :attr:`AcceptanceSettings.min_gain`."""
    MOST_VIEWS = auto()
    """The error rises in most views."""
    OTHER_SIZES = auto()
    """PSNR falls in pictures of another size."""
    NOT_FINITE = auto()
    """Some of the changed Gaussians are not finite."""
    NOT_COMPARED = auto()
    """There are no views to compare renders in."""


class Comparison:
    """Compares scenes with the dense scene: in whole pictures of a middle size, and in subsampled pictures of the
    smallest size, of the full size, and of a larger size that stands for nearer cameras.

    Args:
        dense: N Gaussians, on the device that renders.
        views: source of views.

    Raises:
        DataError: if there are no views.
    """

    def __init__(self, dense: Gaussians, views: ViewSource):
        self.reference = DenseReference(dense, views.compared())
        self.device = dense.device
        whole = views.whole()
        sides = sides_of(whole.width, whole.height)
        others = (sides[0], sides[-1], 4 * sides[-1])
        self._others = RendersOfSizes(dense, whole, others) if len(sides) > 1 else None

    def psnrs(self, scene: Gaussians) -> list[float]:
        """PSNR of a scene in pictures of each other size, dB; empty where pictures have one size."""
        return [] if self._others is None else self._others.psnrs(scene)


@dataclass(frozen=True, eq=False)
class Change:
    """The accepted share of a refinement or repair."""

    scene: Gaussians
    """The scene after this share; the scene before, if no share is accepted."""
    strength: float
    """The share, in (0, 1]; 1 if none is accepted."""
    closeness: Closeness
    """Errors of ``scene``; of the whole change, if no share is accepted."""
    reason: Reason | None
    """Why no share is accepted; None if one is."""


def accept_change(
    judge: Comparison, before: Closeness, old: Gaussians, new: Gaussians, progress: Progress = silent
) -> Change:
    """The share of a refinement or repair with the least error, of those that improve the scene.

    Args:
        judge: compares scenes with the dense scene.
        before: errors of ``old``.
        old, new: the scenes before and after.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].

    Returns:
        The accepted share; its scene is on the device of ``old``.
    """
    start, end = old.to(judge.device), new.to(judge.device)
    tried: dict[float, Closeness] = {}

    @functools.cache
    def least() -> list[float]:
        """Least PSNR in pictures of each other size, dB; rendered only for shares that pass the first check."""
        return [psnr - ACCEPTANCE.most_loss for psnr in judge.psnrs(start)]

    def attempt(strength: float) -> bool:
        """Whether a share of the change passes all checks."""
        done = len(tried)
        scene = interpolate(start, end, strength)
        tried[strength] = judge.reference.closeness(
            scene, lambda share: progress("comparing renders", (done + share) / 3)
        )
        if _why_no_gain(before, tried[strength]) is not None:
            return False
        return all(psnr >= bound for bound, psnr in zip(least(), judge.psnrs(scene), strict=True))

    accepted = [1.0] if attempt(1.0) else []
    clear_gain = bool(accepted) and tried[1.0].psnr >= before.psnr + 0.5  # dB
    if tried[1.0].errors != before.errors and not clear_gain:
        accepted += [0.5] if attempt(0.5) else []
        bottom = parabola_minimum(before.error, tried[0.5].error, tried[1.0].error)
        if all(abs(bottom - share) > 0.05 for share in (0.0, 0.5, 1.0)):  # closer shares hardly differ
            accepted += [bottom] if attempt(bottom) else []
    progress("comparing renders", 1.0)
    if not accepted:
        return Change(old, 1.0, tried[1.0], _why_no_gain(before, tried[1.0]) or Reason.OTHER_SIZES)
    strength = min(accepted, key=lambda share: tried[share].error)
    return Change(interpolate(start, end, strength).to(old.device), strength, tried[strength], None)


def interpolate(before: Gaussians, after: Gaussians, strength: float) -> Gaussians:
    """Interpolate the stored parameters of two scenes linearly (scales as logarithms, opacities as logits).

    Args:
        before, after: N Gaussians each.
        strength: weight of ``after``, in [0, 1].

    Returns:
        N Gaussians. A value whose interpolation is not finite stays as in ``before``.
    """
    if strength == 1:
        return after
    mixed = (a.lerp(b, strength) for a, b in zip(before.tensors(), after.tensors(), strict=True))
    values = zip(before.items(), mixed, strict=True)
    return before.replace(**{name: torch.where(value.isfinite(), value, a) for (name, a), value in values})


def parabola_minimum(at_zero: float, at_half: float, at_one: float) -> float:
    """Minimum in [0, 1] of the parabola through values at 0, 1/2 and 1; NaN if a value is not finite.

    Example:
        >>> round(parabola_minimum(0.3**2, 0.2**2, 0.7**2), 6)
        0.3
    """
    if not all(map(math.isfinite, (at_zero, at_half, at_one))):
        return math.nan
    return top_of_parabola((0.0, 0.5, 1.0), [-at_zero, -at_half, -at_one], 0.0)


def _why_no_gain(before: Closeness, after: Closeness) -> Reason | None:
    """Why errors are no improvement; None if PSNR rises by :attr:`AcceptanceSettings.min_gain` or more, and the error
    falls in at least half of the views. The second condition refuses a gain of few views at the cost of the others."""
    if after.psnr <= before.psnr:
        return Reason.NO_GAIN
    if not after.psnr >= before.psnr + ACCEPTANCE.min_gain:  # NaN too
        return Reason.SMALL_GAIN
    return Reason.MOST_VIEWS if 2 * closer_in(before, after) < len(before.errors) else None


def closer_in(before: Closeness, after: Closeness) -> int:
    """Number of views with a smaller error after than before."""
    return sum(new < old for new, old in zip(after.errors, before.errors, strict=True))
