"""Writes the tradeoff of a scene as one HTML file: an interactive front, pictures to compare, a recommendation,
and a flight through scenes, whose files are kept in the folder of the sweep."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from itertools import count, takewhile
from pathlib import Path
from typing import Any, get_args

import numpy as np

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import read_text, replacing, three_digits, write_json
from pointsplat_ns.pages.flight import FLIGHT_SCRIPTS, FlightFrame
from pointsplat_ns.pages.html import page
from pointsplat_ns.pages.pictures import ERROR_GAIN, error_colors, error_map, fit, read_png
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.front import (
    Cost,
    Metric,
    Reference,
    fastest_above,
    fastest_first,
    fastest_within,
    metric_of,
    pareto_front,
    psnr_within,
)
from pointsplat_ns.tradeoff.points import Point, Tradeoff, flight_path, picture_path, speed_of

FLIGHT_BYTES = 4_000_000
"""Largest size of a page's scenes in bytes; the rest of the page is for its pictures."""


Picture = Callable[[], np.ndarray]


def write_sweep_page(
    sweep: Tradeoff, folder: Path, output: Path, progress: bool | Progress = False, max_bytes: int = 10_000_000
) -> Path:
    """Write one self-contained HTML file with the points of a sweep, which needs no other file; returns its path.

    It plots quality against cost with the Pareto front. A slider along the front shows every view beside the dense
    scene and the photo, with an error map and a wipe. Below are the fastest good point with its command, and a table of
    all points. Views are those with a picture of the dense scene, in the folder of the sweep. The page has a flight
    through the recommended scene, if it is at :func:`~pointsplat_ns.tradeoff.points.flight_path`, beside the dense
    scene if both fit.

    Raises:
        DataError: if there is no point or no view, a picture is missing, damaged or of another size than the views, or
            the page does not fit into ``max_bytes``: it should fit into mails and open quickly.
        SceneError: if the file cannot be written.
    """
    if not sweep.points:
        raise DataError(f"{folder}: nothing was measured; expected the dense scene and at least one smaller one")
    views = _pictures(sweep, folder)
    sources = [picture for view in views for picture in view.values()]
    dense, recommended = sweep.points[0].key, sweep.recommended
    flight = read_flight_beside(flight_path(folder, recommended), flight_path(folder, dense))
    values, data = _values(sweep, len(views)), {**_data(sweep), "flight": flight}
    scripts = ("chart.js", *(FLIGHT_SCRIPTS if flight else ()), "tradeoff.js")

    def filled(uris: list[str], compressed: str) -> str:
        left = iter(uris)
        pictures = [{name: next(left) for name in view} for view in views]
        return page(
            "tradeoff.html", scripts, with_workers=flight is not None, **values, flight=flight,
            data={**data, "pictures": pictures}, compressed=compressed,
        )  # fmt: skip

    empty = filled([""] * len(sources), " " * 100)  # the note on how pictures were compressed is shorter
    text = filled(*fit(sources, max_bytes - len(empty.encode("utf-8")), progress))
    with replacing(output) as part:
        part.write_text(text, encoding="utf-8")
    return output


def _pictures(sweep: Tradeoff, folder: Path) -> list[dict[str, Picture]]:
    """For each view, functions that read or compute its pictures, by name: a point's key, ``photo``, or ``renders:KEY``
    and ``photos:KEY`` for the error map of a point.

    Error maps are computed from the PNG files, so that they do not show errors of the page's compression.
    """
    dense = sweep.points[0].key
    views: list[dict[str, Picture]] = []

    def read(path: Path) -> np.ndarray:
        return read_png(path, width=sweep.width, height=sweep.height)

    def difference(path: Path, reference: Path) -> np.ndarray:
        return error_map(read(path), read(reference))

    for view in takewhile(lambda view: picture_path(folder, view, dense).exists(), count()):
        photo = picture_path(folder, view, "photo")
        has_photo = photo.exists()
        pictures: dict[str, Picture] = {"photo": functools.partial(read, photo)} if has_photo else {}
        for point in sweep.points:
            path = picture_path(folder, view, point.key)
            pictures[point.key] = functools.partial(read, path)
            if point.key != dense:
                pictures[f"renders:{point.key}"] = functools.partial(
                    difference, path, picture_path(folder, view, dense)
                )
            if has_photo:
                pictures[f"photos:{point.key}"] = functools.partial(difference, path, photo)
        views.append(pictures)
    if not views:
        raise DataError(f"{picture_path(folder, 0, dense)}: no such file; expected pictures of at least one view")
    return views


def _values(sweep: Tradeoff, views: int) -> dict[str, Any]:
    """Values for the template itself, without scripts."""
    within_db = 0.5  # initial loss of PSNR against photos
    above_db = round(psnr_within(within_db), 1)  # the same against renders, where there are no photos
    has_photos = metric_of(sweep.points[0], "photos", "psnr") is not None
    has_lpips = any(metric_of(point, "renders", "lpips") is not None for point in sweep.points)
    rows = [{"key": point.key, "label": point.label, "cells": _cells(point, sweep.points[0])} for point in sweep.points]
    titles = {
        "share": "kept",
        "gaussians": "Gaussians",
        "sh_degree": "SH",
        "bytes": "MB",
        "speed": "times as fast",
        "frame_ms": "ms a frame",
        "fill": "fill",
        **{
            f"{reference}_{metric}": f"{title}, {reference}"
            for reference in get_args(Reference)
            for metric, title in zip(get_args(Metric), ("PSNR dB", "SSIM", "LPIPS"), strict=True)
        },
        "seconds": "made in, s",
        "peak_bytes": "peak memory, GB",
    }
    columns = [name for name in titles if (has_photos or "photos" not in name) and (has_lpips or "lpips" not in name)]
    if all(point.peak_bytes is None for point in sweep.points):
        columns.remove("peak_bytes")
    return {
        "sweep": sweep,
        "views": views,
        "references": get_args(Reference) if has_photos else get_args(Reference)[:1],
        "metrics": get_args(Metric) if has_lpips else get_args(Metric)[:2],
        "recommended": fastest_within(sweep.points, within_db, sweep.times_trusted)
        or fastest_above(sweep.points, above_db, sweep.times_trusted)
        or sweep.points[0],
        "rows": rows,
        "columns": [(name, titles[name]) for name in columns],
        "amplified": ERROR_GAIN,
        "full_level": math.ceil(255 / ERROR_GAIN),
        "within_db": within_db,
        "above_db": above_db,
        "ramp": ["#" + bytes(color).hex() for color in error_colors()[::17].tolist()],
    }


def _data(sweep: Tradeoff) -> dict[str, Any]:
    """Data for the scripts, except pictures. An infinite number is the text "Infinity"."""

    def qualities(point: Point, reference: Any) -> dict[str, float | str | None]:
        values = {metric: metric_of(point, reference, metric) for metric in get_args(Metric)}
        return {metric: "Infinity" if value == math.inf else value for metric, value in values.items()}

    def fronts(reference: Any, metric: Any) -> dict[str, list[str]]:
        return {cost: [p.key for p in pareto_front(sweep.points, cost, reference, metric)] for cost in get_args(Cost)}

    return {
        "points": [
            {
                "key": point.key,
                "label": point.label,
                "command": point.command,
                "group": _group(point),
                "low": point.frame_ms_low,
                "high": point.frame_ms_high,
                **{cost: getattr(point, cost) for cost in get_args(Cost)},
                **{reference: qualities(point, reference) for reference in get_args(Reference)},
            }
            for point in sweep.points
        ],
        "fronts": {ref: {metric: fronts(ref, metric) for metric in get_args(Metric)} for ref in get_args(Reference)},
        "fastest": [point.key for point in fastest_first(sweep.points, sweep.times_trusted)],
    }


def _group(point: Point) -> str:
    """Name of the points of one colour."""
    if point.by == "dense":
        return "the dense scene"
    return f"{point.by}, " + ("not repaired" if point.repair == "none" else f"repaired ({point.repair})")


def _cells(point: Point, dense: Point) -> dict[str, tuple[float | None, str]]:
    """A point for the table: by column, a number to sort by (None: unknown) and its text."""
    speed, ms = speed_of(point, dense), point.frame_ms
    cells: dict[str, tuple[float | None, str]] = {
        "share": (point.share, f"{100 * point.share:.3g} %"),
        "gaussians": (point.gaussians, f"{point.gaussians:,}"),
        "sh_degree": (point.sh_degree, str(point.sh_degree)),
        "bytes": (point.bytes, three_digits(point.bytes / 1e6)),
        "speed": (speed.median, f"{speed.median:.2f} ({speed.low:.2f}–{speed.high:.2f})"),
        "frame_ms": (ms, f"{ms:,.0f}" if ms >= 100 else f"{ms:.1f}"),
        "fill": (point.fill, "–" if point.fill is None else f"{point.fill:.1f}"),
        "seconds": (point.seconds, f"{point.seconds:.1f}"),
        "peak_bytes": (point.peak_bytes, "–" if point.peak_bytes is None else f"{point.peak_bytes / 1e9:.2f}"),
    }
    for reference in get_args(Reference):
        for metric, digits in zip(get_args(Metric), (2, 3, 3), strict=True):
            value = metric_of(point, reference, metric)
            text = "–" if value is None else "identical" if value == math.inf else f"{value:.{digits}f}"
            cells[f"{reference}_{metric}"] = (value, text)
    return cells


def keep_flight(frame: FlightFrame, scene: Gaussians, name: str, path: Path) -> bool:
    """Write a scene for the page to a file at :func:`~pointsplat_ns.tradeoff.points.flight_path`, under a name, if it
    is small enough. Returns whether it was written."""
    if ply_bytes(len(scene), scene.sh_degree) > 20 * FLIGHT_BYTES:  # SPZ in a page has at least a tenth of the bytes
        return False
    packed = frame.packed(scene, name)
    if len(packed["spz"]) > 0.99 * FLIGHT_BYTES:  # the rest is for the views
        return False
    write_json(frame.data([packed]), path)
    return True


def read_flight_beside(path: Path, dense: Path) -> dict[str, Any] | None:
    """Read a scene of :func:`keep_flight`, with the dense scene, of another file, on the left if both fit; None if
    there is no such file, or it holds something else."""
    flight = _read(path)
    beside = _read(dense) if dense != path else None
    if flight is None or beside is None:
        return flight
    scenes = [*beside["scenes"], *flight["scenes"]]
    return {**flight, "scenes": scenes} if sum(len(scene["spz"]) for scene in scenes) <= FLIGHT_BYTES else flight


def _read(path: Path) -> dict[str, Any] | None:
    try:
        flight = json.loads(read_text(path, FLIGHT_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    keys = {"scenes", "views", "aspect", "up", "sure", "near", "background", "antialiased", "drag"}
    scenes = flight["scenes"] if isinstance(flight, dict) and flight.keys() == keys else None
    known = (
        isinstance(scenes, list) and scenes and all(isinstance(s, dict) and type(s.get("spz")) is str for s in scenes)
    )
    return flight if known else None
