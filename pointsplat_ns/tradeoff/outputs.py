"""Writes the files of a sweep: table, JSON, plots and the page."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.io.csv_tables import write_csv
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.io.files import replacing, write_json
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.tradeoff.front import Cost, Reference, metric_of, pareto_front
from pointsplat_ns.tradeoff.points import ImageMetrics, Point, Tradeoff, speed_of
from pointsplat_ns.tradeoff.settings import DENSE

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class SweepFiles:
    """Names of the results of a sweep in its folder, beside its journal and its pictures."""

    table: str = "tradeoff.csv"
    json: str = FOLDER_FILES.sweep
    page: str = "tradeoff.html"

    @property
    def plots(self) -> dict[Cost, str]:
        """The plots by cost, the horizontal axis."""
        return {"frame_ms": "tradeoff_ms.png", "bytes": "tradeoff_mb.png", "gaussians": "tradeoff_count.png"}

    @property
    def every(self) -> tuple[str, ...]:
        """All results, in the order of writing."""
        return (self.table, self.json, self.page, *self.plots.values())


SWEEP_FILES = SweepFiles()


def write_outputs(sweep: Tradeoff, folder: Path, progress: Progress = silent) -> None:
    """Write the table, the JSON, the plots and the page of a sweep to its folder, which has the pictures. Raises
    SceneError if a file cannot be written."""
    from pointsplat_ns.tradeoff.page import write_sweep_page

    dense = sweep.points[0]
    points = [{**dataclasses.asdict(point), "speed": speed_of(point, dense)._asdict()} for point in sweep.points]
    write_json({**dataclasses.asdict(sweep), "points": points}, folder / SWEEP_FILES.json)
    write_csv([_row(point, dense) for point in sweep.points], folder / SWEEP_FILES.table)
    for cost, name in SWEEP_FILES.plots.items():
        plot(sweep, cost, folder / name)
    write_sweep_page(sweep, folder, folder / SWEEP_FILES.page, progress)


def _row(point: Point, dense: Point) -> dict[str, object]:
    """A point as a row of the table: qualities and its speed take a column for each number."""
    row: dict[str, object] = {}
    for field in dataclasses.fields(point):
        value = getattr(point, field.name)
        if field.name in ("against_dense", "against_photos"):
            for number in dataclasses.fields(ImageMetrics):
                row[f"{field.name}_{number.name}"] = None if value is None else getattr(value, number.name)
        else:
            row[field.name] = value
    return row | {f"speed_{name}": value for name, value in speed_of(point, dense)._asdict().items()}


def plot(sweep: Tradeoff, cost: Cost, path: Path) -> None:
    """Draw the PSNR of all points over a cost, against the dense scene's renders and, if there are any, photos, to a
    PNG file."""
    from matplotlib.figure import Figure

    panels: dict[Reference, str] = {"renders": "against the dense scene's renders"}
    if sweep.points[0].against_photos is not None:
        panels = {"photos": "against held-out photos", **panels}
    figure = Figure(figsize=(6.4 * len(panels), 4.8), layout="constrained")
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axis, (reference, title) in zip(axes, panels.items(), strict=True):
        _draw(axis, sweep, cost, reference)
        axis.set_title(title, fontsize=10)
    figure.suptitle(f"{sweep.scene}, {sweep.width} x {sweep.height} pixels\n{sweep.machine}", fontsize=9)
    with replacing(path, named=False) as part:
        figure.savefig(part, dpi=150, format="png")


def _draw(axis: Axes, sweep: Tradeoff, cost: Cost, reference: Reference) -> None:
    """One panel: a marker for each point, a line along the front, the dense scene, and the recommended point."""
    dense, *others = sweep.points
    others = [point for point in others if metric_of(point, reference, "psnr") is not None]

    def at(points: list[Point]) -> tuple[list[float], list[float]]:
        costs = [getattr(point, cost) / (1e6 if cost == "bytes" else 1) for point in points]
        return costs, [metric_of(point, reference, "psnr") or 0.0 for point in points]

    front = pareto_front(others, cost, reference, "psnr")
    axis.plot(*at(front), color="0.6", linewidth=1, zorder=1)
    markers = {"none": "o", "refiner": "v", "quick": "s", "thorough": "D", "photos": "P"}
    groups: dict[str, list[Point]] = {}
    for point in others:
        groups.setdefault(_group(point, dense), []).append(point)
    for name, members in groups.items():
        drawn = axis.plot(*at(members), markers[members[0].repair], label=name, markersize=5)
        if cost == "frame_ms":
            low, high = [p.frame_ms_low for p in members], [p.frame_ms_high for p in members]
            axis.hlines(at(members)[1], low, high, drawn[0].get_color(), linewidth=0.8, alpha=0.6)
    for point, x, y in zip(front, *at(front), strict=True):
        axis.annotate(f"{100 * point.share:.3g} %", (x, y), (4, -9), textcoords="offset points", fontsize=7)
    [dense_cost], [dense_psnr] = at([dense])
    if reference == "photos":
        axis.plot(dense_cost, dense_psnr, "*", color="black", label=DENSE, markersize=9)
        axis.axhline(dense_psnr, color="0.8", linewidth=0.8, zorder=0)
    else:
        axis.axvline(dense_cost, color="0.8", linewidth=0.8, zorder=0, label=DENSE)
    best = at([point for point in others if point.key == sweep.recommended])
    if best[0]:
        axis.plot(*best, "o", fillstyle="none", color="crimson", markersize=13, label="recommended")
    _plain_logarithmic(axis)
    labels = {"frame_ms": "milliseconds a frame", "bytes": "size of the file, MB", "gaussians": "Gaussians"}
    axis.set_xlabel(labels[cost] + (", median and quartiles over views" if cost == "frame_ms" else ""))
    axis.set_ylabel("PSNR, dB")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower right")  # a rising front leaves this corner free


def _plain_logarithmic(axis: Axes) -> None:
    """A logarithmic axis with few numbers, not written as powers."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _group(point: Point, dense: Point) -> str:
    """Name of the points of one marker and colour."""
    words = [point.by] + ([] if point.repair == "none" else [point.repair])
    return ", ".join(words + ([] if point.sh_degree == dense.sh_degree else [f"SH degree {point.sh_degree}"]))
