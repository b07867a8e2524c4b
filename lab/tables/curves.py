"""Draws PSNR over the steps of fine-tuning, which shows what is left to gain."""

from __future__ import annotations

from pathlib import Path
from statistics import fmean

from lab.common.printing import percent, save_figure
from lab.common.results import Row
from lab.tables.fine_tune import PUBLISHED_STEPS, Curve
from lab.tables.ways import WAYS, Way, cell_key

TUNED = (WAYS.lightgaussian_tuned, WAYS.pup_tuned)


def mean_curve(cells: dict[str, Row], names: list[str], way: Way, share: float) -> Curve:
    """Steps and mean PSNR over scenes, all of which have these steps; empty if one has no curve."""
    found = [cells.get(cell_key(name, way, share), {}).get("curve") or [] for name in names]
    steps = [[step for step, _ in curve] for curve in found]
    if not all(found) or any(each != steps[0] for each in steps):
        return []
    return [(step, fmean(curve[i][1] for curve in found)) for i, step in enumerate(steps[0])]


def last_gain(curve: Curve) -> float:
    """PSNR gained from half of the steps of the last round to the end, dB.

    Example:
        >>> last_gain([(0, 20.0), (50, 21.0), (100, 21.5)])
        0.5
    """
    return curve[-1][1] - curve[-2][1]


def plot_curves(cells: dict[str, Row], names: list[str], path: Path) -> bool:
    """Draw the curves of all shares, means over scenes; returns False, and draws nothing, if there
    are none."""
    from matplotlib.figure import Figure

    shares = sorted({cell["point"]["share"] for cell in cells.values()}, reverse=True)
    figure = Figure(figsize=(7, 3.6), layout="constrained")
    axis = figure.subplots()
    for way, color in zip(TUNED, ("tab:orange", "gray"), strict=True):
        for share, style in zip(shares[1:], ("-", "--", ":"), strict=False):
            if curve := mean_curve(cells, names, way, share):
                steps, psnr = zip(*curve, strict=True)
                label = f"{way.label}, {percent(share)}"
                axis.plot(steps, psnr, style, color=color, label=label, marker=".")
    if not axis.has_data():
        return False
    axis.set_xlabel(f"steps; the publications take {PUBLISHED_STEPS:,} after each pruning")
    axis.set_ylabel("PSNR in held-out photos, dB")
    axis.set_xscale("symlog", linthresh=10)
    axis.legend(fontsize=8)
    save_figure(figure, path)
    return True
