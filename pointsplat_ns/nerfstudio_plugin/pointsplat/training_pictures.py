"""Pictures of a training: its curves, and a sheet of photo, dense, pruned and refined views."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from pointsplat_ns.nerfstudio_plugin.pointsplat.progress import MOST_ROWS, Curves
from pointsplat_ns.nerfstudio_plugin.pointsplat.verdict import verdict
from pointsplat_ns.system.files import replacing


def plot_curves(curves: Curves, path: Path, title: str) -> None:
    """Draw the loss, and the gain of each scene and their means, against the steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2)
    if curves.loss_history:
        steps, losses = zip(*_thinned(curves.loss_history), strict=True)
        left.plot(steps, losses, color="black", linewidth=1.5)
    left.set(xlabel="steps", ylabel="loss, smoothed", title="Loss, mean over the training scenes")
    left.grid(alpha=0.3)
    series: dict[tuple[bool, str], list[tuple[int, float]]] = {}
    for at in curves.measurements:
        for scene in at.gains:
            series.setdefault((scene.trained_on, scene.name), []).append((at.step, scene.gain))
    styles = {True: ("tab:blue", "-"), False: ("tab:orange", "--")}
    groups = {True: "trained on", False: "not trained on"}
    for trained_on, (color, line) in styles.items():
        members = {name: points for (own, name), points in series.items() if own == trained_on}
        for name, points in members.items():
            right.plot(*zip(*points, strict=True), color=color, linestyle=line, alpha=0.35)
            if len(members) <= MOST_ROWS:
                right.annotate(
                    name,
                    points[-1],
                    xytext=(4, 0),
                    textcoords="offset points",
                    fontsize=8,
                    color=color,
                    va="center",
                    annotation_clip=False,
                )
        if members:
            measured_at = [step for step, _ in next(iter(members.values()))]
            means = np.mean([[gain for _, gain in points] for points in members.values()], axis=0)
            label = f"{groups[trained_on]}, mean of {len(members)}"
            right.plot(
                measured_at,
                means,
                color=color,
                linestyle=line,
                linewidth=2.5,
                marker="o",
                markersize=3,
                label=label,
            )
    right.axhline(0, color="gray", linewidth=1)
    right.set(
        xlabel="steps", ylabel="refined - pruned, dB", title="Gain in fixed views of each scene"
    )
    right.grid(alpha=0.3)
    right.margins(x=0.12)
    if series:
        right.legend(loc="best", fontsize=9)
    said = verdict(curves.measurements[-1].gains) if curves.measurements else ""
    figure.suptitle(f"{title}\n{said}" if said else title, fontsize=10)
    _save(figure, path)


def plot_sheet(
    rows: Sequence[tuple[str, Mapping[str, tuple[Tensor, float | None]]]], path: Path
) -> None:
    """Draw a row for each scene: its label, and pictures (H, W, 3) by their names with their PSNR,
    dB."""
    from matplotlib.figure import Figure

    names = list(dict.fromkeys(name for _, pictures in rows for name in pictures))
    names.sort(key=lambda name: name != "photo")  # stable
    columns = len(names)
    shapes = [next(iter(pictures.values()))[0].shape for _, pictures in rows]
    width = 3.0
    heights = [width * shape[0] / shape[1] + 0.35 for shape in shapes]
    figure = Figure(figsize=(columns * width + 0.6, sum(heights) + 0.3), layout="constrained")
    grid: Any = figure.subplots(len(rows), columns, squeeze=False, height_ratios=heights)
    for axes, (label, pictures) in zip(grid, rows, strict=True):
        for place, name in zip(axes, names, strict=True):
            place.set(xticks=[], yticks=[])
            if name not in pictures:
                place.set_frame_on(False)
                continue
            picture, psnr = pictures[name]
            place.imshow(picture.clamp(0, 1).numpy(), interpolation="nearest")
            place.set_title(name if psnr is None else f"{name}, {psnr:.1f} dB", fontsize=9)
        axes[0].set_ylabel(label, fontsize=9)
    _save(figure, path)


def _thinned(points: Sequence[tuple[int, float]], count: int = 2000) -> Sequence[tuple[int, float]]:
    """Every k-th of the points, and the last."""
    each = max(1, len(points) // count)
    return [*points[:-1][::each], points[-1]]


def _save(figure: Any, path: Path) -> None:
    with replacing(path, named=False) as part:
        figure.savefig(part, format="png", dpi=110, bbox_inches="tight")  # names are not cut
