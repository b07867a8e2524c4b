"""Writes the tradeoff of a scene as one HTML file: an interactive front, pictures to compare, a recommendation,
and a flight through the recommended scene."""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable
from itertools import count, takewhile
from pathlib import Path
from typing import Any

import numpy as np

from pointsplat_ns.compression.quality import word_for
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import read_text, replacing, three_digits, write_json
from pointsplat_ns.pages.flight import FLIGHT_SCRIPTS, FlightFrame
from pointsplat_ns.pages.html import page
from pointsplat_ns.pages.pictures import ERROR_GAIN, error_colors, error_map, fit, read_png
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.points import Point, Tradeoff, picture_path, speed_of
from pointsplat_ns.tradeoff.recommend import fastest_first, psnr_within

FLIGHT_BYTES = 4_000_000
"""Largest size of a page's scenes in bytes; the rest of the page is for its pictures."""

REFERENCES = ("renders", "photos")
METRICS = ("psnr", "ssim", "lpips")


def write_sweep_page(
    sweep: Tradeoff,
    folder: Path,
    output: Path,
    flight: dict[str, Any] | None = None,
    progress: bool | Progress = False,
    max_bytes: int = 10_000_000,
) -> Path:
    """Write one self-contained HTML file with the points of a sweep, which needs no other file; returns its path.

    It plots quality against cost with the Pareto front. A slider along the front shows every view beside the dense
    scene and the photo, with an error map and a wipe. Below are the fastest good point with its command, and a table of
    all points. Views are those with a picture of the dense scene, in the folder of the sweep.

    Args:
        sweep: the points.
        folder: of the sweep, with its pictures.
        output: path of the page.
        flight: data of :func:`flight_beside`, if there is a flight.
        progress: as for :func:`pointsplat_ns.prune`.
        max_bytes: largest size of the page: it should fit into mails and open quickly.

    Raises:
        DataError: if there is no view, a picture is missing, damaged or of another size than the views, or the page
            does not fit into ``max_bytes``.
        SceneError: if the file cannot be written.
    """
    views = _pictures(sweep, folder)
    sources = [picture for view in views for picture in view.values()]
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


def _pictures(sweep: Tradeoff, folder: Path) -> list[dict[str, Callable[[], np.ndarray]]]:
    """For each view, functions that read or compute its pictures, by name: a point's key, ``photo``, or ``renders:KEY``
    and ``photos:KEY`` for the error map of a point.

    Error maps are computed from the PNG files, so that they do not show errors of the page's compression.
    """
    dense = sweep.points[0].key
    views: list[dict[str, Callable[[], np.ndarray]]] = []

    def read(path: Path) -> np.ndarray:
        return read_png(path, width=sweep.width, height=sweep.height)

    def difference(path: Path, reference: Path) -> np.ndarray:
        return error_map(read(path), read(reference))

    for view in takewhile(lambda view: picture_path(folder, view, dense).exists(), count()):
        references = {"renders": picture_path(folder, view, dense)}
        pictures: dict[str, Callable[[], np.ndarray]] = {}
        photo = picture_path(folder, view, "photo")
        if photo.exists():
            references["photos"], pictures["photo"] = photo, functools.partial(read, photo)
        for point in sweep.points:
            path = picture_path(folder, view, point.key)
            pictures[point.key] = functools.partial(read, path)
            for name, reference in references.items():
                if path != reference:
                    pictures[f"{name}:{point.key}"] = functools.partial(difference, path, reference)
        views.append(pictures)
    if not views:
        raise DataError(f"{picture_path(folder, 0, dense)}: no such file; expected pictures of at least one view")
    return views


def _values(sweep: Tradeoff, views: int) -> dict[str, Any]:
    """Values for the template itself, without scripts."""

    def measured(reference: str, metric: str) -> bool:
        return any(metric_of(point, reference, metric) is not None for point in sweep.points)

    return {
        "sweep": sweep,
        "views": views,
        "references": [name for name in REFERENCES if measured(name, "psnr")],
        "metrics": [name for name in METRICS if measured("renders", name)],
        "speed_of": speed_of,
        "metric_of": metric_of,
        "word_for": word_for,
        "three_digits": three_digits,
        "infinity": math.inf,
        "amplified": ERROR_GAIN,
        "full_level": math.ceil(255 / ERROR_GAIN),
        "above_db": round(psnr_within(sweep.within), 1),
        "ramp": ["#" + bytes(color).hex() for color in error_colors()[::17].tolist()],
    }


def _data(sweep: Tradeoff) -> dict[str, Any]:
    """Data for the scripts, except pictures. An infinite number is the text "Infinity"."""

    def qualities(point: Point, reference: str) -> dict[str, float | str | None]:
        values = {metric: metric_of(point, reference, metric) for metric in METRICS}
        return {metric: "Infinity" if value == math.inf else value for metric, value in values.items()}

    same = ("key", "label", "command", "frame_ms", "frame_ms_low", "frame_ms_high", "gaussians", "bytes")
    return {
        "points": [
            {
                "group": _group(point),
                **{name: getattr(point, name) for name in same},
                **{reference: qualities(point, reference) for reference in REFERENCES},
            }
            for point in sweep.points
        ],
        "fastest": [point.key for point in fastest_first(sweep.points, sweep.times_trusted)],
        "found": sweep.recommended if sweep.target else None,
    }


def metric_of(point: Point, reference: str, metric: str) -> float | None:
    """A metric of a point against one of :data:`REFERENCES`; None where it was not measured. A PSNR may be infinite."""
    quality = point.against_dense if reference == "renders" else point.against_photos
    return None if quality is None else getattr(quality, metric)


def _group(point: Point) -> str:
    """Name of the points of one colour."""
    if point.by == "dense":
        return "the dense scene"
    return f"{point.by}, " + ("not repaired" if point.repair == "none" else f"repaired ({point.repair})")


def _scene_path(folder: Path, key: str) -> Path:
    return folder / "scenes" / f"{key}.json"


def keep_scene(frame: FlightFrame, scene: Gaussians, point: Point, folder: Path) -> None:
    """Write a point's scene for the page to the folder of a sweep, if it is small enough."""
    if ply_bytes(len(scene), scene.sh_degree) > 20 * FLIGHT_BYTES:  # SPZ in a page has at least a tenth of the bytes
        return
    packed = frame.packed(scene, point.label)
    if len(packed["spz"]) <= FLIGHT_BYTES:
        write_json(packed, _scene_path(folder, point.key))


def flight_beside(frame: FlightFrame, folder: Path, dense: str, key: str) -> dict[str, Any] | None:
    """Data of a flight through the scene of a point that :func:`keep_scene` wrote, with the dense scene on the left if
    both fit; None if there is no such file, or it holds something else."""
    scenes = [_packed(_scene_path(folder, name)) for name in dict.fromkeys((dense, key))]
    if scenes[-1] is None:
        return None
    found = [scene for scene in scenes if scene is not None]
    return frame.data(found if sum(len(scene["spz"]) for scene in found) <= FLIGHT_BYTES else found[-1:])


def _packed(path: Path) -> dict[str, str] | None:
    try:
        packed = json.loads(read_text(path, FLIGHT_BYTES + 10_000))
    except (OSError, ValueError, RecursionError):
        return None
    known = isinstance(packed, dict) and packed.keys() == {"name", "amount", "spz"}
    return packed if known and all(isinstance(text, str) for text in packed.values()) else None
