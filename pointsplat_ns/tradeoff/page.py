"""Writes the tradeoff of a scene as one HTML file: the recommendation, pictures to compare, a chart and a table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pointsplat_ns.compression.quality import decibels, word_for
from pointsplat_ns.io.files import bytes_text, replacing, three_digits
from pointsplat_ns.pages.html import page
from pointsplat_ns.tradeoff.points import ImageMetrics, Point, Tradeoff
from pointsplat_ns.tradeoff.recommend import next_best


def write_page(found: Tradeoff, pictures: Sequence[dict[str, str]], output: Path) -> None:
    """Write one self-contained HTML file with the points of a scene, which needs no other file.

    Args:
        found: the points.
        pictures: for each view, data URIs of the picture of each point by its key, and of the photo as ``photo``.
        output: path of the page.

    Raises:
        SceneError: if the file cannot be written.
    """
    dense, best = found.points[0], found.point(found.recommended)
    shown = next_best(found.points) or best if best is dense else best
    data = {"points": [_data(point) for point in found.points], "pictures": list(pictures), "shown": shown.key}
    html = page(
        "tradeoff.html", ("tradeoff.js",), found=found, photos=dense.against_photos is not None,
        shown=shown, word_for=word_for, three_digits=three_digits, infinity=math.inf, data=data,
    )  # fmt: skip
    with replacing(output) as part:
        part.write_bytes(html)


def _data(point: Point) -> dict[str, Any]:
    """Data of a point for the scripts; None for what was not measured, or differs in nothing."""

    def finite(quality: ImageMetrics | None) -> dict[str, float | None]:
        psnr = None if quality is None or quality.psnr == math.inf else quality.psnr
        return {"psnr": psnr, "ssim": None if psnr is None or quality is None else quality.ssim}

    figures = [] if point.against_photos is None else [f"{point.against_photos.psnr:.1f} dB against photos"]
    figures += [] if point.by == "dense" else [f"{decibels(point.against_dense.psnr)} against the dense scene"]
    figures += [f"{point.speed.median:.2g} times as fast", f"{point.gaussians:,} Gaussians", bytes_text(point.bytes)]
    repaired = "" if point.repair == "none" else f", repaired ({point.repair})"
    return {
        "key": point.key,
        "label": point.label,
        "command": point.command,
        "group": f"{point.by}{repaired}",
        "figures": ", ".join(figures),
        "frame_ms": point.frame_ms,
        "gaussians": point.gaussians,
        "megabytes": point.bytes / 1e6,
        "renders": finite(point.against_dense),
        "photos": finite(point.against_photos),
    }
