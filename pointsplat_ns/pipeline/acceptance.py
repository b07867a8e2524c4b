"""Accepts a change to a smaller scene, a refinement or a repair, or leaves it out.

The scene after it is compared with the scene before it. It is kept if it gains in whole pictures of
a middle size, lowers the error in at least half of the views, and harms no picture of another size,
or by little of what it gains.
"""

from __future__ import annotations

from dataclasses import dataclass

from pointsplat_ns.pipeline.reasons import Cause, Reason
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.rendering.comparison.closeness import Closeness, DenseReference
from pointsplat_ns.rendering.comparison.sizes import NEARER, RendersOfSizes, sides_of
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.progress import Progress, silent


@dataclass(frozen=True)
class AcceptanceSettings:
    """Thresholds for keeping a change."""

    min_gain: float = 0.1
    """Least gain of PSNR, in dB: the sign of a smaller gain depends on the views."""
    most_loss: float = 0.05
    """Largest loss of PSNR, in dB, in pictures of another size."""
    lost_share: float = 0.25
    """The same as a share of the gain, if that is more: details smaller than a pixel look larger in
    small pictures, so that no few Gaussians are right in all sizes."""


ACCEPTANCE = AcceptanceSettings()

SMALL_GAIN = Reason(Cause.SMALL_GAIN, decibels=ACCEPTANCE.min_gain)
"""Why a change with a smaller gain is left out."""


class Comparison:
    """Compares scenes with the dense scene: in whole pictures of a middle size, and in subsampled
    pictures of the smallest size, of the full size, and of a larger size that stands for nearer
    cameras.

    Args:
        dense: N Gaussians, on the device that renders.
        views: source of views.

    Raises:
        DataError: if there are no views.
    """

    def __init__(self, dense: Gaussians, views: ViewProvider):
        self.reference = DenseReference(dense, views.compared())
        self.device = dense.device
        whole = views.whole()
        sides = sides_of(whole.width, whole.height)
        others = (sides[0], sides[-1], NEARER * sides[-1])
        self._others = RendersOfSizes(dense, whole, others) if len(sides) > 1 else None

    def judged(
        self, before: Closeness, old: Gaussians, new: Gaussians, progress: Progress = silent
    ) -> tuple[Closeness, Reason | None]:
        """Errors of a changed scene, and why it is left out; None if it is accepted.

        Args:
            before: errors of ``old``.
            old, new: the scenes before and after.
            progress: called with the name of the current task and the share of it that is done, in
                [0, 1].
        """
        end = new.to(self.device)
        after = self.reference.closeness(end, lambda share: progress("comparing renders", share))
        reason = _why_no_gain(before, after)
        if reason is None and self._others is not None:
            lost = max(ACCEPTANCE.most_loss, ACCEPTANCE.lost_share * (after.psnr - before.psnr))
            least = (psnr - lost for psnr in self._others.psnrs(old.to(self.device)))
            if not all(
                psnr >= bound for bound, psnr in zip(least, self._others.psnrs(end), strict=True)
            ):  # NaN too
                reason = Reason(Cause.WORSE_IN_OTHER_SIZES)
        return after, reason


def _why_no_gain(before: Closeness, after: Closeness) -> Reason | None:
    """Why errors are no improvement; None if PSNR rises by :attr:`AcceptanceSettings.min_gain` or
    more, and the error falls in at least half of the views. The second condition refuses a gain of
    few views at the cost of the others."""
    if after.errors == before.errors:
        return Reason(Cause.NO_CHANGE)
    if after.psnr <= before.psnr:
        return Reason(Cause.NO_GAIN)
    if not after.psnr >= before.psnr + ACCEPTANCE.min_gain:  # NaN too
        return SMALL_GAIN
    if 2 * closer_in(before, after) < len(before.errors):
        return Reason(Cause.WORSE_IN_MOST_VIEWS)
    return None


def closer_in(before: Closeness, after: Closeness) -> int:
    """Number of views with a smaller error after than before."""
    return sum(new < old for new, old in zip(after.errors, before.errors, strict=True))
