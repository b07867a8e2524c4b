"""The files of a sweep: all points as JSON, from which the next call resumes, a table, and the page."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.io.files import one_line, read_text, write_csv, write_json
from pointsplat_ns.tradeoff.points import ImageMetrics, Point, Speed, Tradeoff, restored_point, speed_of
from pointsplat_ns.tradeoff.settings import Setting, setting_of

VERSION = 4
"""Version of the JSON. Points of version 1 were timed without the dense scene beside them, some of version 2 drawn in
other qualities; up to version 3 they were in another file."""


@dataclass(frozen=True)
class SweepFiles:
    """Names of the results of a sweep in its folder, beside its pictures."""

    json: str = FOLDER_FILES.sweep
    table: str = "tradeoff.csv"
    page: str = "tradeoff.html"


SWEEP_FILES = SweepFiles()


def check_folder(folder: Path) -> None:
    """Raise a SceneError if a folder has results without the JSON to resume from."""
    for name in (SWEEP_FILES.table, SWEEP_FILES.page):
        if (folder / name).exists() and not (folder / SWEEP_FILES.json).exists():
            raise SceneError(
                f"{folder / name}: exists already, without {SWEEP_FILES.json} to resume from; name another folder, or "
                "overwrite it with --force"
            )


def write_points(sweep: Tradeoff, identity: Mapping[str, str | int], folder: Path) -> None:
    """Write all points as JSON. ``identity`` has the values that comparable points have in common, by name."""
    write_json(
        {"version": VERSION, "of": identity, **dataclasses.asdict(sweep), "points": _rows(sweep)},
        folder / SWEEP_FILES.json,
    )


def write_table(sweep: Tradeoff, folder: Path) -> None:
    """Write all points as CSV. Qualities and speeds take a column for each number."""
    numbers: dict[str, tuple[str, ...]] = {"speed": Speed._fields}
    for name in ("against_dense", "against_photos"):
        numbers[name] = tuple(field.name for field in dataclasses.fields(ImageMetrics))
    rows = _rows(sweep)
    for row in rows:
        for name, parts in numbers.items():
            values = row.pop(name) or {}
            row |= {f"{name}_{part}": values.get(part) for part in parts}
    write_csv(rows, folder / SWEEP_FILES.table)


def _rows(sweep: Tradeoff) -> list[dict[str, Any]]:
    """The values of all points, with their speeds."""
    dense = sweep.points[0]
    return [{**dataclasses.asdict(point), "speed": speed_of(point, dense)._asdict()} for point in sweep.points]


def read_points(folder: Path, identity: Mapping[str, str | int]) -> dict[Setting, Point]:
    """The points of an earlier call by setting. The file is not trusted; there are none if there is no file. Raises
    SceneError if it is damaged or of another version, or its points are of another identity."""
    path, mend = folder / SWEEP_FILES.json, "name another folder, or start over with --force"
    if not path.exists():
        return {}
    try:
        content = json.loads(read_text(path, 16_000_000))  # a thousand points take one megabyte
        if content["version"] != VERSION:
            raise ValueError(f"of version {content['version']!r:.20}, this program's are of {VERSION}")
        of, rows = dict(content["of"]), content["points"]
        points = [restored_point({name: row[name] for name in row if name != "speed"}) for row in rows]
        found = {setting_of(point): point for point in points}
    except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError, PointSplatError) as error:
        why = f"lacks {error}" if isinstance(error, KeyError) else one_line(error, 80)
        raise SceneError(f"{path}: not the points of a sweep ({why}); {mend}") from error
    for name, value in identity.items():
        if of.get(name) != value:
            raise SceneError(
                f"{path}: its points are of another sweep ({name}: {of.get(name)!r}, now {value!r}); {mend}"
            )
    return found
