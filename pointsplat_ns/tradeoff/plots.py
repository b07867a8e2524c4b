"""Plots of a sweep: quality against frame time, size and count."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.io.files import replacing
from pointsplat_ns.tradeoff.front import Cost, pareto_front
from pointsplat_ns.tradeoff.points import Point, Tradeoff
from pointsplat_ns.tradeoff.settings import DENSE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

AXES = {"ms": "milliseconds a frame", "mb": "size of the file, MB", "count": "Gaussians"}
"""What quality is plotted against."""

_COSTS: dict[str, Cost] = {"ms": "frame_ms", "mb": "bytes", "count": "gaussians"}

_MARKERS = {"none": "o", "refiner": "v", "quick": "s", "thorough": "D"}


def plot(sweep: Tradeoff, against: str, path: Path) -> None:
    """Draw the PSNR of all points, against the dense scene's renders and, if there are any, photos.

    Args:
        sweep: what was measured.
        against: one of :data:`AXES`.
        path: the PNG file to write.

    Raises:
        SceneError: if it cannot be written.
    """
    from matplotlib.figure import Figure

    dense = sweep.points[0]
    panels = ["against the dense scene's renders"]
    if dense.against_photos is not None:
        panels.insert(0, "against held-out photos")
    figure = Figure(figsize=(6.4 * len(panels), 4.8), layout="constrained")
    for axis, title in zip(figure.subplots(1, len(panels), squeeze=False)[0], panels, strict=True):
        _draw(axis, sweep, against, photos="photos" in title)
        axis.set_title(title, fontsize=10)
    figure.suptitle(f"{sweep.scene}, {sweep.width} x {sweep.height} pixels\n{sweep.machine}", fontsize=9)
    with replacing(path) as part:
        figure.savefig(part, dpi=150, format="png")


def cost(point: Point, against: str) -> float:
    """What a point costs, in the units of :data:`AXES`."""
    value: float = getattr(point, _COSTS[against])
    return value / 1e6 if against == "mb" else value


def _draw(axis: Axes, sweep: Tradeoff, against: str, photos: bool) -> None:
    """One panel: a marker for each point, a line along the front, the dense scene, and what is recommended."""
    dense, *others = sweep.points
    of_dense = dense.against_photos if photos else None
    qualities = [(point, point.against_photos if photos else point.against_dense) for point in others]
    found = [(point, quality.psnr) for point, quality in qualities if quality is not None]
    costs, values = [cost(point, against) for point, _ in found], [value for _, value in found]
    joined = pareto_front([point for point, _ in found], _COSTS[against], "photos" if photos else "renders", "psnr")
    best = [[point for point, _ in found].index(point) for point in joined]
    axis.plot([costs[i] for i in best], [values[i] for i in best], color="0.6", linewidth=1, zorder=1)
    groups: dict[str, list[int]] = {}
    for i, (point, _) in enumerate(found):
        groups.setdefault(_group(point, dense), []).append(i)
    for name, members in groups.items():
        first = found[members[0]][0]
        drawn = axis.plot(
            [costs[i] for i in members], [values[i] for i in members], _MARKERS[first.repair], label=name, markersize=5
        )
        if against == "ms":
            low, high = ([getattr(found[i][0], name) for i in members] for name in ("frame_ms_low", "frame_ms_high"))
            axis.hlines([values[i] for i in members], low, high, drawn[0].get_color(), linewidth=0.8, alpha=0.6)
    for i in best:
        axis.annotate(
            f"{100 * found[i][0].share:.3g} %", (costs[i], values[i]), (4, -9), textcoords="offset points", fontsize=7
        )
    if of_dense is not None:
        axis.plot([cost(dense, against)], [of_dense.psnr], "*", color="black", label=DENSE, markersize=9)
        axis.axhline(of_dense.psnr, color="0.8", linewidth=0.8, zorder=0)
    else:
        axis.axvline(cost(dense, against), color="0.8", linewidth=0.8, zorder=0, label=DENSE)
    for i, (point, value) in enumerate(found):
        if point.key == sweep.recommended:
            axis.plot([costs[i]], [value], "o", fillstyle="none", color="crimson", markersize=13, label="recommended")
    _plain_logarithmic(axis)
    axis.set_xlabel(AXES[against] + (", median and quartiles over views" if against == "ms" else ""))
    axis.set_ylabel("PSNR, dB")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8, loc="lower right")  # where a front that rises leaves room


def _plain_logarithmic(axis: Axes) -> None:
    """A logarithmic axis with numbers that are not written as powers, and few enough of them to be read."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    axis.set_xscale("log")
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _group(point: Point, dense: Point) -> str:
    """What the points of one marker and colour have in common."""
    words = [point.by] + ([] if point.repair == "none" else [point.repair])
    words += [] if point.drawn == "exact" else [f"drawn {point.drawn}"]
    return ", ".join(words + ([] if point.sh_degree == dense.sh_degree else [f"SH degree {point.sh_degree}"]))
