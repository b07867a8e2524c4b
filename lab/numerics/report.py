"""How far each thing is trusted, from the rows of stability.py, as tables and pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from lab.common.printing import markdown, save_figure
from lab.numerics.cases import SWEEPS, Sweep
from lab.numerics.measures import Row

TRUSTED = 1e-2
"""Relative error up to which a result is trusted: 2.5 steps of an 8-bit image, 1 % of a
gradient."""

MOST_DOUBT = 1e-3
"""Where the reference and the fast path, both in float64, are farther apart than this, nothing is
judged."""

DRAWN = (1e-9, 10.0)
"""Smaller and larger errors, and what is not finite, are drawn here."""

Curve = tuple[str, str]
"""What is measured, and the quantity."""

RASTERIZERS = {"eager": "ours", "compiled": "compiled", "rounded input": "input"}
COLOURS = {"eager": "tab:blue", "compiled": "tab:cyan", "rounded input": "0.6"}
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
    """How far a curve is trusted, from the usual value to either side, and whether it ends where
    nothing is judged.

    Args:
        rows: of one curve and sweep, ascending.
        sweep: for the usual value.

    Example:
        >>> sweep = Sweep("scale", "", (0.1, 1.0, 10.0), None)
        >>> rows = [Row("", "", "", "scale", value, error) for value, error in ((0.1, 1e-6), (1.0, 1e-6), (10.0, 0.1))]
        >>> limits(rows, sweep)
        ('to 1', False)
    """
    if not rows:
        return "-", False
    start = min(range(len(rows)), key=lambda i: abs(math.log(rows[i].value / sweep.usual)))
    if rows[start].error > TRUSTED:
        return "nowhere", False
    ends = []
    unjudged = False
    for side in (range(start, -1, -1), range(start, len(rows))):
        held = start
        for i in side:
            if rows[i].doubt > MOST_DOUBT or rows[i].error > TRUSTED:
                unjudged |= rows[i].doubt > MOST_DOUBT
                break
            held = i
        ends.append(held)
    low, high = ends
    words = [f"from {_number(rows[low].value)}"] if low > 0 else []
    words += [f"to {_number(rows[high].value)}"] if high < len(rows) - 1 else []
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
    used = [name for name in RASTERIZERS if any(row.what == name for row in rows)]
    first = {
        (name, kind): f"{RASTERIZERS[name]}: {kind}"
        for name in used
        for kind in ("image", "gradient")
    }
    return "\n\n".join(_table(rows, curves) for curves in (first, OTHERS))


def _measured(rows: Sequence[Row]) -> list[Sweep]:
    return [sweep for sweep in SWEEPS if any(row.sweep == sweep.name for row in rows)]


def _table(rows: Sequence[Row], curves: dict[Curve, str]) -> str:
    lines = []
    for sweep in _measured(rows):
        cells = []
        for what, quantity in curves:
            here = curve(rows, sweep.name, what, quantity)
            text, unjudged = limits(here, sweep)
            worst = max((row.error for row in here if row.doubt <= MOST_DOUBT), default=0.0)
            if text == "all":
                text = f"all ({worst:.0e})" if worst else "all (0)"
            cells.append(text + ("\\*" if unjudged else ""))
        lines.append(
            [sweep.label, f"{_number(sweep.values[0])} to {_number(sweep.values[-1])}", *cells]
        )
    return markdown(["Driven", "Measured", *curves.values()], lines)


def plot(rows: Sequence[Row], folder: Path) -> None:
    """Errors against what was driven, a panel for each property: rasterizer.png and others.png."""
    styles = {"image": "-", "gradient": ":"}
    labels = {**RASTERIZERS, "rounded input": "float32 input, exact arithmetic"}
    rasterizers = {
        (name, kind): (f"{labels[name]}: {kind}", COLOURS[name], style)
        for name in reversed(RASTERIZERS)
        for kind, style in styles.items()
    }
    others = {
        key: (label, f"C{i}", "-" if i < 3 else "--" if i < 5 else ":")
        for i, (key, label) in enumerate(OTHERS.items())
    }
    title = "Error of {} in float32 against {}float64{}"
    _plot(
        rows,
        rasterizers,
        folder / "rasterizer.png",
        title.format("the rasterizer", "the ", " reference"),
    )
    _plot(rows, others, folder / "others.png", title.format("merging, scores and refiner", "", ""))


def _plot(
    rows: Sequence[Row], curves: dict[Curve, tuple[str, str, str]], path: Path, title: str
) -> None:
    from matplotlib.figure import Figure

    sweeps = _measured(rows)
    lines = -(-len(sweeps) // 3)
    figure = Figure(figsize=(11, 2.6 * lines + 1.2), layout="constrained")
    axes = figure.subplots(lines, 3, squeeze=False, sharey=True).flatten()
    for axis, sweep in zip(axes, sweeps, strict=False):
        for (what, quantity), (label, colour, style) in curves.items():
            here = [
                row for row in curve(rows, sweep.name, what, quantity) if row.doubt <= MOST_DOUBT
            ]
            heights = [min(max(row.error, DRAWN[0]), DRAWN[1]) for row in here]
            axis.plot(
                [row.value for row in here],
                heights,
                style,
                color=colour,
                label=label,
                marker=".",
                markersize=4,
            )
        axis.axhline(TRUSTED, color="black", linewidth=0.8)
        axis.set(xscale="log", yscale="log", ylim=(DRAWN[0] / 2, DRAWN[1] * 2))
        axis.set_xlabel(sweep.label, fontsize=8)
        axis.tick_params(labelsize=8)
        axis.grid(alpha=0.3)
    for axis in axes[len(sweeps) :]:
        axis.set_axis_off()
    for axis in axes[::3]:
        axis.set_ylabel("relative error")
    figure.legend(
        *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8
    )
    figure.suptitle(title, fontsize=11)
    save_figure(figure, path, dpi=80)
