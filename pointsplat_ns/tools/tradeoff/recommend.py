"""Computes the loss of points in dB, and recommends the fastest point within a loss.

With photos, the loss is measured: the PSNR of the dense scene minus the PSNR of the smaller scene.
Without photos it is estimated: a trained scene typically has :data:`PHOTO_PSNR` against its photos;
the error of a smaller scene is independent of it, so squared errors add up.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pointsplat_ns.system.files import bytes_text
from pointsplat_ns.tools.tradeoff.points import Point

PHOTO_PSNR = 27.0
"""Assumed PSNR of a trained scene against held-out photos, dB: about that of 3DGS on common
benchmarks."""


def expected_loss(psnr: float) -> float:
    """Expected loss against photos, dB, of a scene with a PSNR (dB) against the dense scene."""
    return 10 * math.log10(1 + 10 ** ((PHOTO_PSNR - psnr) / 10))


def psnr_within(loss: float) -> float:
    """PSNR against the dense scene, dB, with an expected loss (dB, above 0)."""
    return PHOTO_PSNR - 10 * math.log10(10 ** (loss / 10) - 1)


def loss_of(point: Point, dense: Point) -> float:
    """Loss of a point, dB: measured against photos, or else expected."""
    if point.against_photos is not None and dense.against_photos is not None:
        return dense.against_photos.psnr - point.against_photos.psnr
    return expected_loss(point.against_dense.psnr)


def next_best(points: Sequence[Point]) -> Point | None:
    """The point with the smallest loss except the dense scene, which is the first; None if there is
    no other."""
    return min(
        points[1:], key=lambda point: (loss_of(point, points[0]), point.gaussians), default=None
    )


def fastest_within(points: Sequence[Point], loss: float, trusted: bool = True) -> Point:
    """The fastest point that loses at most ``loss`` dB; ties go to the fewest Gaussians, then to
    the smallest file. The first point is the dense scene, which loses nothing. Times are ignored
    unless ``trusted``."""
    # 1e-9, because floating-point differences are not exact: 30.1 - 29.6 is more than 0.5.
    enough = [point for point in points if loss_of(point, points[0]) <= loss + 1e-9]
    return min(
        enough, key=lambda point: (point.frame_ms if trusted else 0.0, point.gaussians, point.bytes)
    )


def recommend(points: Sequence[Point], within: float, trusted: bool = True) -> tuple[Point, str]:
    """:func:`fastest_within`, with a text on the point. If it is the dense scene, the text also has
    the figures of the best other point."""
    dense = points[0]
    best = fastest_within(points, within, trusted)
    other = next_best(points)
    if dense.against_photos is not None:
        limit = f"that loses at most {within:g} dB against held-out photos"
        value = "" if other is None else f"loses {loss_of(other, dense):.2f} dB"
    else:
        limit = f"above {psnr_within(within):.1f} dB ({within:g} dB of loss against photos)"
        value = "" if other is None else f"has {other.against_dense.psnr:.1f} dB"
    if best is not dense:
        quality = "fastest" if trusted else "smallest"
        return best, f"{quality} point {limit}: {best.label}, {_figures(best, dense, trusted)}"
    reason = f"no {'faster' if trusted else 'smaller'} point {limit}"
    if other is not None:
        reason += (
            f"; the best, {other.label}, {value}: {_figures(other, dense, trusted)}, made in "
            f"{other.seconds:.0f} s"
        )
    return dense, reason


def _figures(point: Point, dense: Point, trusted: bool) -> str:
    """Count, size and, if times are trusted, frame time."""
    figures = (
        f"{point.gaussians:,} Gaussians, {bytes_text(point.bytes)} in place of "
        f"{bytes_text(dense.bytes)}"
    )
    if not trusted:
        return figures
    speed = f"{point.speed.median:.2g} times as fast"
    return f"{figures}, {speed}: {point.frame_ms:.3g} ms per frame in place of {dense.frame_ms:.3g}"
