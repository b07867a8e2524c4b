"""Limits and figures from the rows of benchmarks/stability.py."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from stability_cases import SWEEPS, Sweep
from stability_measures import Row

from pointsplat_ns.io.files import replacing

if TYPE_CHECKING:
    from matplotlib.axes import Axes

TRUSTED = 1e-2
"""Relative error up to which a result is trusted: 2.5 steps of an 8-bit image, 1 % of a gradient."""

MOST_DOUBT = 1e-3
"""Where the reference and the fast path, both in float64, are farther apart than this, nothing is judged."""

LEAST = 1e-9
"""Smaller errors are drawn here."""

MOST = 10.0
"""Larger errors, and what is not finite, are drawn here."""

Curve = tuple[str, str]
"""What is measured, and the quantity."""

RASTERIZERS = {"eager": "ours", "compiled": "compiled", "classic": "gsplat's formulas", "rounded input": "input"}
OTHERS: dict[Curve, str] = {
    ("merge", "cost"): "merge: cost of a pair",
    ("merge", "pairs"): "merge: share of pairs chosen",
    ("merge", "merged"): "merge: picture of the result",
    ("LightGaussian", "score"): "LightGaussian's score",
    ("PUP-3DGS", "score"): "PUP-3DGS's score",
    ("refiner", "residual"): "refiner: residuals",
    ("refiner", "gradient"): "refiner: gradient of its weights",
}


def limits(rows: Sequence[Row], sweep: Sweep) -> tuple[str, bool]:
    """How far a curve is trusted, from the usual value to either side, and whether it ends where nothing is judged.

    Args:
        rows: of one curve and sweep, ascending.
        sweep: for the usual value.

    Example:
        >>> from stability_cases import in_other_units
        >>> sweep = Sweep("scale", "", (0.1, 1.0, 10.0), in_other_units)
        >>> rows = [Row("", "", "", "scale", value, error) for value, error in ((0.1, 1e-6), (1.0, 1e-6), (10.0, 0.1))]
        >>> limits(rows, sweep)
        ('to 1', False)
    """
    if not rows:
        return "-", False
    start = min(range(len(rows)), key=lambda i: abs(math.log(rows[i].value / sweep.usual)))
    if rows[start].error > TRUSTED:
        return "nowhere", False
    ends, unjudged = [], False
    for side in (range(start, -1, -1), range(start, len(rows))):
        held = start
        for i in side:
            if rows[i].doubt > MOST_DOUBT:
                unjudged = True
                break
            if rows[i].error > TRUSTED:
                break
            held = i
        ends.append(held)
    low, high = ends
    words = []
    if low > 0:
        words.append(f"from {_number(rows[low].value)}")
    if high < len(rows) - 1:
        words.append(f"to {_number(rows[high].value)}")
    return " ".join(words) or "all", unjudged


def _number(value: float) -> str:
    if 1 <= value < 1000:
        return f"{value:.0f}"
    mantissa, exponent = f"{value:.0e}".split("e")
    return f"{mantissa}e{int(exponent)}"


def curve(rows: Sequence[Row], sweep: str, what: str, quantity: str) -> list[Row]:
    """The rows of one curve, ascending."""
    here = [row for row in rows if (row.sweep, row.what, row.quantity) == (sweep, what, quantity)]
    return sorted(here, key=lambda row: row.value)


def tables(rows: Sequence[Row]) -> str:
    """Two Markdown tables: how far rasterizers are trusted, and how far everything else is."""
    sweeps = [sweep for sweep in SWEEPS if any(row.sweep == sweep.name for row in rows)]
    used = [name for name in RASTERIZERS if any(row.what == name for row in rows)]
    columns = [(name, quantity) for name in used for quantity in ("image", "gradient")]
    heads = [f"{RASTERIZERS[name]}: {quantity}" for name, quantity in columns]
    return "\n\n".join(
        (_table(rows, sweeps, columns, heads), _table(rows, sweeps, list(OTHERS), list(OTHERS.values())))
    )


def _table(rows: Sequence[Row], sweeps: Sequence[Sweep], columns: Sequence[Curve], heads: Sequence[str]) -> str:
    lines = [f"| Driven | Measured | {' | '.join(heads)} |", "|---|---|" + "---|" * len(heads)]
    for sweep in sweeps:
        cells = []
        for what, quantity in columns:
            here = curve(rows, sweep.name, what, quantity)
            text, unjudged = limits(here, sweep)
            worst = max((row.error for row in here if row.doubt <= MOST_DOUBT), default=0.0)
            if text == "all":
                text = f"all ({worst:.0e})" if worst else "all (0)"
            cells.append(text + ("\\*" if unjudged else ""))
        values = f"{_number(sweep.values[0])} to {_number(sweep.values[-1])}"
        lines.append(f"| {sweep.label} | {values} | {' | '.join(cells)} |")
    return "\n".join(lines)


def plot_rasterizers(rows: Sequence[Row], path: Path) -> None:
    """Errors of image and gradient of each rasterizer against what was driven, a panel each."""
    colours = {"eager": "tab:blue", "compiled": "tab:cyan", "classic": "tab:red", "rounded input": "0.6"}
    styles = {"image": "-", "gradient": ":"}
    labels = {**RASTERIZERS, "rounded input": "float32 input, exact arithmetic"}
    curves = {
        (name, quantity): (f"{labels[name]}: {quantity}", colours[name], styles[quantity])
        for name in ("rounded input", "classic", "compiled", "eager")
        for quantity in ("image", "gradient")
    }
    _plot(rows, curves, path, "Error of the rasterizer in float32 against the float64 reference")


def plot_others(rows: Sequence[Row], path: Path) -> None:
    """Errors of scores, merging and refiner against what was driven, a panel each."""
    curves = {
        key: (label, f"C{i}", "-" if i < 3 else "--" if i < 5 else ":") for i, (key, label) in enumerate(OTHERS.items())
    }
    _plot(rows, curves, path, "Error of merging, scores and refiner in float32 against float64")


def _plot(rows: Sequence[Row], curves: dict[Curve, tuple[str, str, str]], path: Path, title: str) -> None:
    from matplotlib.figure import Figure
    from PIL import Image

    sweeps = [sweep for sweep in SWEEPS if any(row.sweep == sweep.name for row in rows)]
    lines = -(-len(sweeps) // 3)
    figure = Figure(figsize=(11, 2.6 * lines + 1.2), layout="constrained")
    axes = figure.subplots(lines, 3, squeeze=False, sharey=True).flatten()
    for axis, sweep in zip(axes, sweeps, strict=False):
        _panel(axis, rows, sweep, curves)
    for axis in axes[len(sweeps) :]:
        axis.set_axis_off()
    for axis in axes[::3]:
        axis.set_ylabel("relative error")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8)
    figure.suptitle(title, fontsize=11)
    with replacing(path) as part:
        figure.savefig(part, dpi=100, format="png")
        with Image.open(part) as picture:  # lines need few colours
            small = picture.convert("RGB").quantize(64)
        small.save(part, "PNG", optimize=True)


def _panel(axis: Axes, rows: Sequence[Row], sweep: Sweep, curves: dict[Curve, tuple[str, str, str]]) -> None:
    for (what, quantity), (label, colour, style) in curves.items():
        here = [row for row in curve(rows, sweep.name, what, quantity) if row.doubt <= MOST_DOUBT]
        heights = [min(max(row.error, LEAST), MOST) for row in here]
        axis.plot([row.value for row in here], heights, style, color=colour, label=label, marker=".", markersize=4)
    axis.axhline(TRUSTED, color="black", linewidth=0.8)
    axis.set(xscale="log", yscale="log", ylim=(LEAST / 2, MOST * 2))
    axis.set_xlabel(sweep.label, fontsize=8)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.3)
