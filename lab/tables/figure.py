"""Figure 4: distributions of opacity and volume of the Gaussians kept."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import torch

from lab.common.printing import save_figure
from lab.common.results import Row
from lab.tables.ways import PROTOCOL, WAYS, cell_key
from pointsplat_ns.pruning.paper import log_volume
from pointsplat_ns.scene.gaussians import Gaussians

OPACITY_EDGES = np.linspace(0.0, 1.0, 41)
"""Edges of the bins of opacity."""

VOLUME_EDGES = np.linspace(-20.0, 4.0, 49)
"""Edges of the bins of log10 of the volume, scene units cubed; values outside count in the first or
the last bin."""

COLORS = {
    "dense": "black",
    "lightgaussian": "tab:orange",
    "pup": "gray",
    "paper": "tab:blue",
    "merge": "tab:green",
}

Group = dict[str, list[str]]
"""Names of scenes, by the name of their group."""


def distributions(scene: Gaussians) -> tuple[list[int], list[int]]:
    """Numbers of Gaussians in the bins of opacity and of volume."""
    usable = scene[scene.usable()]
    volumes = (log_volume(usable) / math.log(10)).clamp(*VOLUME_EDGES[[0, -1]].tolist())
    found = []
    for values, edges in ((usable.alphas, OPACITY_EDGES), (volumes, VOLUME_EDGES)):
        counts = torch.histc(values.double().flatten().cpu(), len(edges) - 1, edges[0], edges[-1])
        found.append([int(count) for count in counts])
    return found[0], found[1]


def share_of_figure(cells: dict[str, Row], names: list[str]) -> float:
    """The paper's share where the paper's selection was measured at it, or else the largest
    measured share."""
    keys = {
        key for key, cell in cells.items() if cell["way"] == WAYS.paper.name and cell["opacities"]
    }
    shares = {cells[key]["point"]["share"] for key in keys if key.split("/")[0] in names}
    return (
        PROTOCOL.figure_share
        if PROTOCOL.figure_share in shares
        else max(shares, default=PROTOCOL.figure_share)
    )


def densities(cells: dict[str, Row], names: list[str]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Shares of the Gaussians in each bin of opacity and of volume by way: means over the scenes of
    a group that have every way which any of them has."""
    share = share_of_figure(cells, names)
    keys = {
        w.name: [cell_key(name, w, 1.0 if w == WAYS.dense else share) for name in names]
        for w in WAYS.figure_4
    }
    there = {
        w: {k.split("/")[0] for k in of if cells.get(k, {}).get("opacities")}
        for w, of in keys.items()
    }
    measured = [scenes for scenes in there.values() if scenes]
    over = set.intersection(*measured) if measured else set()
    found = {}
    for way, of in keys.items():
        counts = [cells[key] for key in of if key in cells and key.split("/")[0] in over]
        if counts:
            shares = (
                [np.array(c[kind]) / sum(c[kind]) for c in counts]
                for kind in ("opacities", "volumes")
            )
            opacity, volume = (np.mean(each, axis=0) for each in shares)
            found[way] = (opacity, volume)
    return found


def medians(cells: dict[str, Row], names: list[str]) -> dict[str, tuple[float, float]]:
    """Medians of opacity and of log10 of the volume (scene units cubed), by way, interpolated
    within bins."""

    def middle(shares: np.ndarray, edges: np.ndarray) -> float:
        below = np.concatenate([[0.0], np.cumsum(shares)])  # share of the Gaussians below each edge
        return float(np.interp(0.5 * below[-1], below, edges))

    found = densities(cells, names).items()
    return {
        way: (middle(opacity, OPACITY_EDGES), middle(volume, VOLUME_EDGES))
        for way, (opacity, volume) in found
    }


def plot_figure(cells: dict[str, Row], groups: Group, path: Path) -> None:
    """Draw Figure 4, a row for each group."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6 * len(groups)), layout="constrained")
    for (name, scenes), axes in zip(
        groups.items(), figure.subplots(len(groups), 2, squeeze=False), strict=True
    ):
        found = densities(cells, scenes)
        for way in WAYS.figure_4:
            for axis, shares, edges in zip(
                axes, found.get(way.name, ()), (OPACITY_EDGES, VOLUME_EDGES), strict=False
            ):
                style = "--" if way == WAYS.dense else "-"
                axis.stairs(
                    100 * shares,
                    edges,
                    color=COLORS[way.name],
                    linestyle=style,
                    label=way.label,
                    linewidth=1.4,
                )
        if found:
            filled = np.flatnonzero(np.max([volume for _, volume in found.values()], axis=0) > 1e-3)
            axes[1].set_xlim(VOLUME_EDGES[filled[0]], VOLUME_EDGES[filled[-1] + 1])
        axes[0].set_title(f"{name}, {100 * share_of_figure(cells, scenes):g} % kept", fontsize=10)
        axes[0].set(xlabel="opacity", ylabel="% of the Gaussians in a bin")
        axes[1].set_xlabel("log10 of the volume, scene units cubed")
    drawn = [axis for axis in figure.axes if axis.has_data()]
    if drawn:
        figure.legend(
            *drawn[0].get_legend_handles_labels(), loc="outside upper center", ncols=5, fontsize=8
        )
    save_figure(figure, path)
