"""What a smaller scene loses, in dB, and which point is the fastest within a loss.

Where there are photos, the loss is measured: the PSNR of the dense scene against them less that of the smaller one.
Where there are none, it is what photos would show if they were there. A trained scene is typically :data:`PHOTO_PSNR`
away from its photos, and what a smaller scene changes is independent of that error, so that the squared errors add up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pointsplat_ns.tradeoff.front import fastest_above, fastest_within
from pointsplat_ns.tradeoff.points import Point, speed_of

PHOTO_PSNR = 27.0
"""PSNR in dB of a trained scene against held-out photos, where it is not known: about what 3DGS reaches on the captures
that papers report."""


def expected_loss(psnr: float) -> float:
    """The loss against photos, dB, of a scene whose renders have a PSNR (dB) against the dense scene's.

    Example:
        >>> expected_loss(float("inf")), round(expected_loss(27.0), 2), round(expected_loss(36.14), 2)
        (0.0, 3.01, 0.5)
    """
    return 10 * math.log10(1 + 10 ** ((PHOTO_PSNR - psnr) / 10))


def psnr_within(loss: float) -> float:
    """The PSNR against the dense scene's renders, dB, at which a loss (dB, above 0) is expected.

    Example:
        >>> round(psnr_within(0.5), 1), round(psnr_within(1.0), 1)
        (36.1, 32.9)
    """
    return PHOTO_PSNR - 10 * math.log10(10 ** (loss / 10) - 1)


def loss_of(point: Point, dense: Point) -> float:
    """What a point loses, dB: measured against photos, or else expected."""
    if point.against_photos is not None and dense.against_photos is not None:
        return dense.against_photos.psnr - point.against_photos.psnr
    return expected_loss(point.against_dense.psnr)


def recommend(points: Sequence[Point], within: float, trusted: bool = True) -> tuple[Point, str]:
    """The fastest point within a loss, and a line of text that says so.

    Args:
        points: the dense scene, then others.
        within: the largest loss, dB.
        trusted: as for :func:`~pointsplat_ns.tradeoff.front.fastest_first`.
    """
    dense = points[0]
    best = fastest_within(points, within, trusted) or fastest_above(points, psnr_within(within), trusted) or dense
    if dense.against_photos is not None:
        limit = f"within {within:g} dB of the dense scene's {dense.against_photos.psnr:.1f} dB against held-out photos"
    else:
        limit = (
            f"of at least {psnr_within(within):.1f} dB against the dense scene's renders, which costs {within:g} dB "
            f"against photos that it meets with {PHOTO_PSNR:g} dB"
        )
    what = "fastest point" if trusted else "point with the fewest Gaussians"
    if best is dense:
        return dense, f"the {what} {limit} is the dense scene itself"
    figures = f"{best.gaussians:,} Gaussians, {best.bytes / 1e6:.2f} MB"
    if trusted:
        figures += f", {speed_of(best, dense)}: {best.frame_ms:.3g} ms a frame in place of {dense.frame_ms:.3g}"
    return best, f"the {what} {limit}: {best.label}, {figures}"
