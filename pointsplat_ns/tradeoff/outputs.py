"""What a sweep writes of its points: tables, plots and the page."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

from pointsplat_ns.io.files import replacing, write_json
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.tradeoff.plots import plot
from pointsplat_ns.tradeoff.points import Point, Quality, Tradeoff, speed_of

TABLE, JSON, PAGE = "tradeoff.csv", "tradeoff.json", "tradeoff.html"
PLOTS = {"ms": "tradeoff_ms.png", "mb": "tradeoff_mb.png", "count": "tradeoff_count.png"}
"""Names of the plots by what quality is plotted against."""

OUTPUTS = (TABLE, JSON, PAGE, *PLOTS.values())


def write_outputs(sweep: Tradeoff, folder: Path, progress: Progress = silent) -> None:
    """Write the table, the JSON, the plots and the page of a sweep.

    Args:
        sweep: what was measured.
        folder: of the sweep, with the pictures.
        progress: called while pictures are compressed for the page.

    Raises:
        SceneError: if a file cannot be written.
    """
    from pointsplat_ns.tradeoff.page import write_page

    dense = sweep.points[0]
    points = [{**dataclasses.asdict(point), "speed": speed_of(point, dense)._asdict()} for point in sweep.points]
    write_json({**dataclasses.asdict(sweep), "points": points}, folder / JSON)
    _write_table(sweep, folder / TABLE)
    for against, name in PLOTS.items():
        plot(sweep, against, folder / name)
    write_page(sweep, folder, folder / PAGE, progress)


def _write_table(sweep: Tradeoff, path: Path) -> None:
    rows = [_row(point, sweep.points[0]) for point in sweep.points]
    with replacing(path) as part, part.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _row(point: Point, dense: Point) -> dict[str, object]:
    """A point as a row of the table: qualities and its speed take a column for each number."""
    row: dict[str, object] = {}
    for field in dataclasses.fields(point):
        value = getattr(point, field.name)
        if field.name in ("against_dense", "against_photos"):
            for number in dataclasses.fields(Quality):
                row[f"{field.name}_{number.name}"] = None if value is None else getattr(value, number.name)
        else:
            row[field.name] = value
    return row | {f"speed_{name}": value for name, value in speed_of(point, dense)._asdict().items()}
