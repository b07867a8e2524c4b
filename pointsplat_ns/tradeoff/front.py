"""Which of the measured points are worth having: the Pareto front, and the fastest that is good enough."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

from pointsplat_ns.tradeoff.points import Point, Quality

Reference = Literal["renders", "photos"]
"""What a point was compared with: renders of the dense scene, or held-out photos."""
Metric = Literal["psnr", "ssim", "lpips"]
Cost = Literal["frame_ms", "gaussians", "bytes"]

REFERENCES: tuple[Reference, ...] = ("renders", "photos")
METRICS: tuple[Metric, ...] = ("psnr", "ssim", "lpips")
COSTS: tuple[Cost, ...] = ("frame_ms", "gaussians", "bytes")


def quality_of(point: Point, reference: Reference, metric: Metric) -> float | None:
    """A metric of a point; None where it was not measured. A PSNR may be infinite."""
    quality: Quality | None = point.against_dense if reference == "renders" else point.against_photos
    value = None if quality is None else getattr(quality, metric)
    return None if value is None or math.isnan(value) else value


def pareto_front(points: Sequence[Point], cost: Cost, reference: Reference, metric: Metric) -> list[Point]:
    """The points that no other beats in both cost and quality, cheapest first.

    Of points that are equal in both, the first is taken. Points without the metric are left out.
    """
    sign = -1 if metric == "lpips" else 1  # LPIPS is a distance: less is better
    judged = [(point, sign * value) for point in points if (value := quality_of(point, reference, metric)) is not None]
    front: list[Point] = []
    best = -math.inf
    for point, quality in sorted(judged, key=lambda pair: (getattr(pair[0], cost), -pair[1])):
        if quality > best:
            front.append(point)
            best = quality
    return front


def fastest_first(points: Sequence[Point], trusted: bool = True) -> list[Point]:
    """The points by their time of a frame; of those as fast, the fewer Gaussians and the smaller file first.

    Args:
        points: any points.
        trusted: whether times mean anything. If not, they go by their Gaussians, as these are what drawing takes time
            for.
    """
    return sorted(points, key=lambda point: (point.frame_ms if trusted else 0.0, point.gaussians, point.bytes))


def fastest_within(points: Sequence[Point], db: float, trusted: bool = True) -> Point | None:
    """The fastest point whose PSNR against photos is at most ``db`` below that of the first point, the dense scene;
    ``trusted`` as for :func:`fastest_first`.

    Returns:
        The point; None where there are no photos.
    """
    dense = quality_of(points[0], "photos", "psnr")
    return None if dense is None else _fastest(points, "photos", dense - db, trusted)


def fastest_above(points: Sequence[Point], db: float, trusted: bool = True) -> Point | None:
    """The fastest point that has at least ``db`` of PSNR against the dense scene's own renders; ``trusted`` as for
    :func:`fastest_first`.

    Returns:
        The point; None only if there is none, as the dense scene itself has an infinite PSNR.
    """
    return _fastest(points, "renders", db, trusted)


def _fastest(points: Sequence[Point], reference: Reference, least: float, trusted: bool) -> Point | None:
    # 1e-9: a difference of two decimal numbers is not exact, and 0.5 dB less than 30.1 is not 29.6.
    for point in fastest_first(points, trusted):
        quality = quality_of(point, reference, "psnr")
        if quality is not None and quality >= least - 1e-9:
            return point
    return None
