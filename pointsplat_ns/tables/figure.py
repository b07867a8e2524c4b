"""Figure 4: distributions of opacity and volume of the Gaussians that methods keep at half the count."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from pointsplat_ns.io.files import replacing
from pointsplat_ns.tables.cells import BINS
from pointsplat_ns.tables.means import Group
from pointsplat_ns.tables.ways import DENSE_WAY, FIGURE_4, PROTOCOL, Way

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def medians(group: Group) -> dict[str, tuple[float, float]]:
    """Medians of opacity and of log10 of the volume (scene units cubed), by way, interpolated within bins. All scenes
    have the same weight. Ways without measurements are left out."""
    found = {}
    for way, share in FIGURE_4:
        both = densities(group, way.name, share)
        if both is not None:
            found[way.name] = (_median(both[0], BINS.opacity_edges), _median(both[1], BINS.volume_edges))
    return found


def densities(group: Group, way: str, share: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Shares of the Gaussians in each bin of opacity and of volume, means over scenes; None if there are none."""
    opacities, volumes = [], []
    for scene in group.scenes:
        cell = scene.cells.get((way, share))
        if cell is not None and cell.opacities and cell.volumes and sum(cell.opacities) and sum(cell.volumes):
            opacities.append(np.array(cell.opacities) / sum(cell.opacities))
            volumes.append(np.array(cell.volumes) / sum(cell.volumes))
    return (np.mean(opacities, axis=0), np.mean(volumes, axis=0)) if opacities else None


def plot_figure(groups: Sequence[Group], path: Path) -> None:
    """Draw Figure 4, a row for each group."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6 * len(groups)), layout="constrained")
    for group, (left, right) in zip(groups, figure.subplots(len(groups), 2, squeeze=False), strict=True):
        for way, share in FIGURE_4:
            both = densities(group, way.name, share)
            if both is not None:
                _stairs(left, both[0], BINS.opacity_edges, way)
                _stairs(right, both[1], BINS.volume_edges, way)
        right.set_xlim(*_extent(group))
        left.set_xlabel("opacity")
        right.set_xlabel("log10 of the volume, scene units cubed")
        left.set_ylabel("% of the Gaussians in a bin")
        left.set_title(f"{group.name}, {100 * PROTOCOL.figure_share:g} % kept", fontsize=10)
    drawn = [axis for axis in figure.axes if axis.has_data()]
    if drawn:
        figure.legend(*drawn[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8)
    with replacing(path) as part:
        figure.savefig(part, dpi=110, format="png")


def _extent(group: Group) -> tuple[float, float]:
    """Range of log10 of the volume over the bins with more than 0.1 % of the Gaussians."""
    found = [both[1] for way, share in FIGURE_4 if (both := densities(group, way.name, share)) is not None]
    filled: np.ndarray = np.flatnonzero(np.max(found, axis=0) > 1e-3) if found else np.empty(0, int)
    edges = BINS.volume_edges
    return (edges[filled[0]], edges[filled[-1] + 1]) if len(filled) else BINS.volume_span


def _stairs(axis: Axes, shares: np.ndarray, edges: np.ndarray, way: Way) -> None:
    colors = {"lightgaussian": "tab:orange", "pup": "gray", "paper": "tab:blue", "merge": "tab:green", "dense": "black"}
    style = "--" if way == DENSE_WAY else "-"
    axis.stairs(100 * shares, edges, color=colors[way.name], linestyle=style, label=way.label, linewidth=1.4)


def _median(shares: np.ndarray, edges: np.ndarray) -> float:
    below = np.concatenate([[0.0], np.cumsum(shares)])  # share of the Gaussians below each edge
    return float(np.interp(0.5 * below[-1], below, edges))
