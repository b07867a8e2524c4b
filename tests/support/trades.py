"""A trade that is known in advance."""

import math

from pointsplat_ns.tools.tradeoff.points import ImageMetrics, Point, Speed


def point(key: str, ms: float, psnr: float, photos: float | None, count: int) -> Point:
    """A point of a scene whose frames take 100 ms."""
    speed = Speed(*3 * [100 / ms])
    against_photos = None if photos is None else ImageMetrics(photos, 0.8)
    of = (f"the {key}", f"make {key}", key, 1.0, count, "none", 10 * count)
    return Point(
        key, *of, ImageMetrics(psnr, 0.9), against_photos, speed, ms, fill=1.0, seconds=3.0
    )


POINTS = [
    point("dense", 100, math.inf, 30.1, 100),
    point("half", 60, 42.0, 30.0, 50),
    point("slow", 70, 35.0, 29.9, 60),  # beaten by half in everything
    point("third", 40, 36.0, 29.6, 30),
    point("tenth", 20, 30.0, 28.0, 10),
]
