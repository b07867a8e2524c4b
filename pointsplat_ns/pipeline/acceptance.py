"""Accepts or rejects a change to a smaller scene: a refinement or a repair.

Renders before and after the change are compared with the dense scene. A change is accepted if PSNR
rises in whole pictures of a middle size, error falls in at least half of the views, and PSNR in
pictures of other sizes falls by at most a small share of the gain.
"""

from __future__ import annotations

from dataclasses import dataclass

from pointsplat_ns.pipeline.reasons import Cause, Reason
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.rendering.comparison.closeness import Closeness, DenseReference
from pointsplat_ns.rendering.comparison.sizes import RendersOfSizes, other_sizes
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.progress import Progress, silent


@dataclass(frozen=True)
class AcceptanceSettings:
    """Thresholds for accepting a change."""

    min_gain: float = 0.1
    """Minimum gain of PSNR, dB. The sign of a smaller gain depends on the choice of views."""
    max_loss: float = 0.05
    """Maximum loss of PSNR in pictures of other sizes, dB."""
    max_loss_share: float = 0.25
    """The same as a share of the gain; the larger of both limits applies. Details below a pixel
    look larger in small pictures, so few Gaussians cannot match all sizes at once."""


ACCEPTANCE = AcceptanceSettings()

SMALL_GAIN = Reason(Cause.SMALL_GAIN, decibels=ACCEPTANCE.min_gain)
"""Reason to reject a change with a smaller gain."""


class Comparison:
    """Compares scenes with the dense scene.

    Pictures of a middle size are compared whole. Pictures of the smallest size, the full size and a
    larger size, which stands for nearer cameras, are subsampled.

    Args:
        dense: N Gaussians, on the device that renders.
        views: source of views.

    Raises:
        DataError: if there are no views.
    """

    def __init__(self, dense: Gaussians, views: ViewProvider):
        self.reference = DenseReference(dense, views.compared())
        self.device = dense.device
        others = other_sizes(views.whole())
        self._others = RendersOfSizes(dense, others) if others else None

    def judge(
        self, before: Closeness, old: Gaussians, new: Gaussians, progress: Progress = silent
    ) -> tuple[Closeness, Reason | None]:
        """Errors of a changed scene, and the reason to reject it; None if it is accepted.

        Args:
            before: errors of ``old``.
            old, new: the scenes before and after.
            progress: called with the name of the current task and the share of it that is done, in
                [0, 1].
        """
        end = new.to(self.device)
        after = self.reference.closeness(end, lambda share: progress("comparing renders", share))
        reason = _rejection(before, after)
        if reason is None and self._others is not None:
            lost = max(ACCEPTANCE.max_loss, ACCEPTANCE.max_loss_share * (after.psnr - before.psnr))
            bounds = (psnr - lost for psnr in self._others.psnrs(old.to(self.device)))
            pairs = zip(bounds, self._others.psnrs(end), strict=True)
            # ``not all``: a PSNR of NaN is rejected too.
            if not all(psnr >= bound for bound, psnr in pairs):
                reason = Reason(Cause.WORSE_IN_OTHER_SIZES)
        return after, reason


def _rejection(before: Closeness, after: Closeness) -> Reason | None:
    """Reason to reject a change; None if PSNR rises by :attr:`AcceptanceSettings.min_gain` or more,
    and error falls in at least half of the views. The second condition rejects a gain in few views
    at the cost of the others."""
    if after.errors == before.errors:
        return Reason(Cause.NO_CHANGE)
    if after.psnr <= before.psnr:
        return Reason(Cause.NO_GAIN)
    if not after.psnr >= before.psnr + ACCEPTANCE.min_gain:  # NaN too
        return SMALL_GAIN
    if 2 * views_improved(before, after) < len(before.errors):
        return Reason(Cause.WORSE_IN_MOST_VIEWS)
    return None


def views_improved(before: Closeness, after: Closeness) -> int:
    """Number of views in which the error falls."""
    return sum(new < old for new, old in zip(after.errors, before.errors, strict=True))
