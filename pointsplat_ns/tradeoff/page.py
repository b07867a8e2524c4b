"""The trade of a scene as one HTML file: its front to hover and click, its pictures to compare, a recommendation."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import replacing
from pointsplat_ns.pages.flight import SCRIPTS
from pointsplat_ns.pages.html import page
from pointsplat_ns.pages.pictures import AMPLIFIED, error_colors, error_map, fit, read_png
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.flights import read_flight_beside
from pointsplat_ns.tradeoff.front import (
    COSTS,
    METRICS,
    REFERENCES,
    fastest_above,
    fastest_first,
    fastest_within,
    pareto_front,
    psnr_within,
    quality_of,
)
from pointsplat_ns.tradeoff.points import Point, Tradeoff, flight_path, picture_path, speed_of

MAX_BYTES = 10_000_000
"""Size of the page, at most: what goes through mail and opens at once."""

WITHIN_DB = 0.5
"""PSNR in dB to lose against photos, as the page asks at first."""

ABOVE_DB = round(psnr_within(WITHIN_DB), 1)
"""The same where there are no photos: PSNR to have against renders of the dense scene."""


def write_page(sweep: Tradeoff, folder: Path, output: Path, progress: bool | Progress = False) -> Path:
    """Write one self-contained HTML file that shows a trade: it loads nothing and opens from a double click.

    It has the points' quality against their cost with the Pareto front, a slider along the front that shows every view
    at each point beside the dense scene and the photo with an error map and a wipe, the fastest point that is good
    enough with the command that makes it, and a table of all points. Views are those of which there is a picture of the
    dense scene. The recommended scene is there to fly through, if it is at
    :func:`~pointsplat_ns.tradeoff.points.flight_path`, beside the dense one if both fit.

    Args:
        sweep: what was measured. Its first point is the dense scene.
        folder: the folder of the sweep, with the pictures at
            :func:`~pointsplat_ns.tradeoff.points.picture_path`. Photos may be missing.
        output: the file to write.
        progress: show a progress bar while pictures are compressed.

    Returns:
        ``output``.

    Raises:
        DataError: if there is no point or no view, if a picture is missing, damaged or of another size than the views,
            or if the page does not fit into 10 MB.
        SceneError: if the file cannot be written.
    """
    if not sweep.points:
        raise DataError(f"{folder}: nothing was measured; expected the dense scene and at least one smaller one")
    pictures = _Pictures.of(sweep, folder)
    dense, recommended = sweep.points[0].key, sweep.recommended
    flight = read_flight_beside(flight_path(folder, recommended), flight_path(folder, dense))
    values, data = _values(sweep, len(pictures.names)), {**_data(sweep), "flight": flight}
    scripts = ("chart.js", *(SCRIPTS if flight else ()), "tradeoff.js")

    def filled(uris: list[str], compressed: str) -> str:
        shown = {**data, "pictures": pictures.placed(uris)}
        return page(
            "tradeoff.html", scripts, with_workers=flight is not None, **values, flight=flight, data=shown,
            compressed=compressed,
        )  # fmt: skip

    empty = filled([""] * len(pictures.sources), " " * 100)  # of how pictures were compressed is said in fewer letters
    text = filled(*fit(pictures.sources, MAX_BYTES - len(empty.encode("utf-8")), progress))
    with replacing(output) as part:
        part.write_text(text, encoding="utf-8")
    return output


@dataclass
class _Pictures:
    """What pictures the page shows, and where they belong."""

    sources: list[Callable[[], np.ndarray]] = field(default_factory=list)
    """One function for each picture that reads or computes it."""
    names: list[dict[str, int]] = field(default_factory=list)
    """For each view, the index of each of its pictures by name: a point's key, ``photo``, or ``renders:KEY`` and
    ``photos:KEY`` for the error map of a point."""

    @classmethod
    def of(cls, sweep: Tradeoff, folder: Path) -> _Pictures:
        """All pictures of a sweep. Error maps are computed from the PNG files: what compression for the page changes
        must not show as error."""
        read = functools.partial(read_png, width=sweep.width, height=sweep.height)
        dense = sweep.points[0].key
        pictures = cls()
        for view in count():
            if not picture_path(folder, view, dense).exists():
                break
            names: dict[str, int] = {}
            photo = picture_path(folder, view, "photo")
            if photo.exists():
                names["photo"] = pictures._add(read, photo)
            for point in sweep.points:
                path = picture_path(folder, view, point.key)
                names[point.key] = pictures._add(read, path)
                references = {"renders": picture_path(folder, view, dense)} if point.key != dense else {}
                references |= {"photos": photo} if photo.exists() else {}
                for reference, other in references.items():
                    names[f"{reference}:{point.key}"] = pictures._add(_read_difference, read, path, other)
            pictures.names.append(names)
        if not pictures.names:
            raise DataError(f"{picture_path(folder, 0, dense)}: no such file; expected pictures of at least one view")
        return pictures

    def _add(self, source: Callable[..., np.ndarray], *args: Any) -> int:
        self.sources.append(functools.partial(source, *args))
        return len(self.sources) - 1

    def placed(self, uris: list[str]) -> list[dict[str, str]]:
        """For each view, the URI of each of its pictures by name."""
        return [{name: uris[index] for name, index in view.items()} for view in self.names]


def _read_difference(read: Callable[[Path], np.ndarray], picture: Path, reference: Path) -> np.ndarray:
    return error_map(read(picture), read(reference))


def _values(sweep: Tradeoff, views: int) -> dict[str, Any]:
    """What the template shows without the help of a script."""
    has_photos = quality_of(sweep.points[0], "photos", "psnr") is not None
    has_lpips = any(quality_of(point, "renders", "lpips") is not None for point in sweep.points)
    return {
        "sweep": sweep,
        "views": views,
        "references": REFERENCES if has_photos else REFERENCES[:1],
        "metrics": METRICS if has_lpips else METRICS[:2],
        "recommended": fastest_within(sweep.points, WITHIN_DB, sweep.times_trusted)
        or fastest_above(sweep.points, ABOVE_DB, sweep.times_trusted)
        or sweep.points[0],
        "rows": [_row(point, sweep.points[0]) for point in sweep.points],
        "columns": _columns(has_photos, has_lpips, any(point.peak_bytes is not None for point in sweep.points)),
        "amplified": AMPLIFIED,
        "full_level": math.ceil(255 / AMPLIFIED),
        "within_db": WITHIN_DB,
        "above_db": ABOVE_DB,
        "ramp": ["#" + bytes(color).hex() for color in error_colors()[::17].tolist()],
    }


def _data(sweep: Tradeoff) -> dict[str, Any]:
    """What the scripts read, but for the pictures. An infinite number is the text "Infinity"."""
    return {
        "points": [
            {
                "key": point.key,
                "label": point.label,
                "command": point.command,
                "group": _group(point),
                "low": point.frame_ms_low,
                "high": point.frame_ms_high,
                **{cost: getattr(point, cost) for cost in COSTS},
                **{
                    reference: {metric: _finite(quality_of(point, reference, metric)) for metric in METRICS}
                    for reference in REFERENCES
                },
            }
            for point in sweep.points
        ],
        "fronts": {
            reference: {
                metric: {cost: [p.key for p in pareto_front(sweep.points, cost, reference, metric)] for cost in COSTS}
                for metric in METRICS
            }
            for reference in REFERENCES
        },
        "fastest": [point.key for point in fastest_first(sweep.points, sweep.times_trusted)],
    }


def _group(point: Point) -> str:
    """What points of one colour have in common."""
    if point.by == "dense":
        return "the dense scene"
    group = f"{point.by}, " + ("not repaired" if point.repair == "none" else f"repaired ({point.repair})")
    return group if point.drawn == "exact" else f"{group}, drawn {point.drawn}"


def _finite(value: float | None) -> float | str | None:
    return "Infinity" if value == math.inf else value


def _columns(has_photos: bool, has_lpips: bool, has_peak: bool) -> list[tuple[str, str]]:
    """Names in :func:`_row` and titles of the table's columns."""
    columns = [
        ("share", "kept"),
        ("gaussians", "Gaussians"),
        ("sh_degree", "SH"),
        ("bytes", "MB"),
        ("speed", "times as fast"),
        ("frame_ms", "ms a frame"),
    ]
    for reference, title in zip(REFERENCES[: 1 + has_photos], ("renders", "photos"), strict=False):
        names = (("psnr", "PSNR dB"), ("ssim", "SSIM"), ("lpips", "LPIPS"))[: 2 + has_lpips]
        columns += [(f"{reference}_{metric}", f"{name}, {title}") for metric, name in names]
    columns.append(("seconds", "made in, s"))
    return columns + ([("peak_bytes", "peak memory, GB")] if has_peak else [])


def _row(point: Point, dense: Point) -> dict[str, Any]:
    """A point for the table: by column, a number to sort by (None: unknown) and its text."""
    speed = speed_of(point, dense)
    cells: dict[str, tuple[float | None, str]] = {
        "share": (point.share, f"{100 * point.share:.3g} %"),
        "gaussians": (point.gaussians, f"{point.gaussians:,}"),
        "sh_degree": (point.sh_degree, str(point.sh_degree)),
        "bytes": (point.bytes, f"{point.bytes / 1e6:.2f}"),
        "speed": (speed.median, f"{speed.median:.2f} ({speed.low:.2f}–{speed.high:.2f})"),
        "frame_ms": (point.frame_ms, _time(point.frame_ms)),
        "seconds": (point.seconds, f"{point.seconds:.1f}"),
        "peak_bytes": (point.peak_bytes, "–" if point.peak_bytes is None else f"{point.peak_bytes / 1e9:.2f}"),
    }
    for reference in REFERENCES:
        for metric, digits in zip(METRICS, (2, 3, 3), strict=True):
            value = quality_of(point, reference, metric)
            text = "–" if value is None else "identical" if value == math.inf else f"{value:.{digits}f}"
            cells[f"{reference}_{metric}"] = (value, text)
    return {"key": point.key, "label": point.label, "cells": cells}


def _time(ms: float) -> str:
    return f"{ms:,.0f}" if ms >= 100 else f"{ms:.1f}"
