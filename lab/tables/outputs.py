"""Writes all cells of a folder: tables in Markdown and LaTeX, all figures in JSON, and Figure 4."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lab.tables.cells import BINS, TABLE_FILES
from lab.tables.layout import Layout, Table, figure_medians, latex_document, markdown_table, markdown_text
from lab.tables.means import Group, read_groups
from lab.tables.ways import PROTOCOL, WAYS, Way, published
from pointsplat_ns.io.files import replacing, write_json
from pointsplat_ns.tradeoff.machine import is_busy

if TYPE_CHECKING:
    from matplotlib.axes import Axes


READING = (
    "Figures are means over the same scenes in all rows of a table, but for rows with a mark. PSNR (dB), SSIM and "
    'LPIPS (AlexNet) are against held-out photos; those of "renders" against the dense scene\'s own renders in the '
    'same poses. "Loses most" names the scene that loses most PSNR compared to its dense scene, with its PSNR and the '
    "difference; among dense scenes it is the one of the least PSNR. \\*: nothing is fine-tuned or refined."
)


def write_tables(folder: Path, shares: Sequence[float], missing: Mapping[str, str]) -> list[Group]:
    """Write the tables of all scenes with cells in a folder, which has a folder for each; returns the scenes in groups.

    ``shares`` are those of Table 1, for rows without measurements; ``missing`` has reasons for missing cells, by key.
    Raises SceneError if a journal cannot be read, there is none, or a file cannot be written.
    """
    groups = read_groups(folder)
    tables = {group.name: Layout(group, shares, missing).tables() for group in groups}
    for group in groups:
        if found := medians(group):
            tables[group.name].append(figure_medians(group, found))
    write_json(_content(groups, missing), folder / TABLE_FILES.json)
    with replacing(folder / TABLE_FILES.markdown, named=False) as part:
        part.write_text(_markdown(groups, tables), encoding="utf-8")
    with replacing(folder / TABLE_FILES.latex, named=False) as part:
        every = [table for members in tables.values() for table in members]
        part.write_text(latex_document(every, [READING.replace("\\", ""), *_notes(groups)]), encoding="utf-8")
    plot_figure(groups, folder / TABLE_FILES.figure)
    return groups


def _markdown(groups: Sequence[Group], tables: Mapping[str, Sequence[Table]]) -> str:
    lines = [READING, "", *(line for note in _notes(groups) for line in (markdown_text(note), ""))]
    for group in groups:
        lines += [f"## {markdown_text(group.name)}", ""]
        differs = bool(group.dataset) and not group.comparable_dataset
        lines += ["| scene | Gaussians | judged in | size |" + " differs from the paper in |" * differs]
        lines += ["|---|---|---|---|" + "---|" * differs]
        for scene in group.scenes:
            about, dense = scene.about, scene.cells.get((WAYS.dense.name, 1.0))
            words = (
                about.name,
                "-" if dense is None else f"{dense.point.gaussians:,}",
                f"{about.views} {about.origin}",
                f"{about.width} x {about.height}",
                *((about.differs,) if differs else ()),
            )
            lines.append("| " + " | ".join(map(markdown_text, words)) + " |")
        lines += ["", *(markdown_table(table) for table in tables[group.name])]
    lines += [f"![Figure 4]({TABLE_FILES.figure})", "", "*Figure 4: opacity and volume of the Gaussians kept.*", ""]
    return "\n".join(lines)


def _notes(groups: Sequence[Group]) -> list[str]:
    """Lines of text on the conditions of the measurements."""
    machines = sorted({scene.about.machine for group in groups for scene in group.scenes})
    cells = [cell for group in groups for scene in group.scenes for cell in scene.cells.values()]
    made = sorted({f"{cell.version}, commit {cell.commit}" if cell.commit else cell.version for cell in cells})
    notes = [f"Measured on {'; '.join(machines)}, by pointsplat_ns {'; '.join(made)}."]
    others = [cell.point.others_cores for cell in cells if cell.point.others_cores is not None]
    busy = [cores for cores in others if is_busy(cores)]
    if busy:
        notes.append(
            f"The machine was busy: while {len(busy)} of {len(cells)} cells were timed, other programs took up to "
            f"{max(busy):.1f} cores. Table 2 leaves their frames a second out; --only measures them again."
        )
    if any(group.comparable_dataset for group in groups):
        notes.append(
            "The paper's Table 2 and Figure 4 do not say of which scenes they are, and its LPIPS is by VGG, so nothing "
            "of theirs is shown beside ours."
        )
    return notes


def _content(groups: Sequence[Group], missing: Mapping[str, str]) -> dict[str, Any]:
    return {
        "format": "pointsplat-tables",
        "version": 1,
        "groups": {group.name: [scene.about.name for scene in group.scenes] for group in groups},
        "scenes": [dataclasses.asdict(scene.about) for group in groups for scene in group.scenes],
        "cells": [
            dataclasses.asdict(cell) for group in groups for scene in group.scenes for cell in scene.cells.values()
        ],
        "paper": {group.name: _published(group) for group in groups if group.comparable_dataset},
        "not_measured": dict(missing),
    }


def _published(group: Group) -> dict[str, Any]:
    """The paper's figures for a group of the same dataset and protocol, by table, way and share."""
    found: dict[str, Any] = {}
    for number in (1, 3, 4):
        for way, share in sorted({key for scene in group.scenes for key in scene.cells}):
            quality = published(number, group.comparable_dataset, way, share)
            if quality is not None:
                found[f"table {number}, {way}, {100 * share:g}%"] = dataclasses.asdict(quality)
    return found


def medians(group: Group) -> dict[str, tuple[float, float]]:
    """Medians of opacity and of log10 of the volume (scene units cubed), by way, interpolated within bins. All scenes
    have the same weight. Ways without measurements are left out."""
    found = {}
    for way, share in WAYS.figure_4:
        both = densities(group, way.name, share)
        if both is not None:
            found[way.name] = (_median(both[0], BINS.opacity_edges), _median(both[1], BINS.volume_edges))
    return found


def densities(group: Group, way: str, share: float) -> tuple[np.ndarray, np.ndarray] | None:
    """Shares of the Gaussians in each bin of opacity and of volume, means over the scenes that the ways of Figure 4
    share; None if one of them lacks this way."""
    opacities, volumes = [], []
    over = group.shared((shown.name, kept) for shown, kept in WAYS.figure_4)
    for scene in group.scenes:
        if scene.about.name not in over:
            continue
        cell = scene.cells.get((way, share))
        if cell is None:
            return None
        if cell.opacities and cell.volumes and sum(cell.opacities) and sum(cell.volumes):
            opacities.append(np.array(cell.opacities) / sum(cell.opacities))
            volumes.append(np.array(cell.volumes) / sum(cell.volumes))
    return (np.mean(opacities, axis=0), np.mean(volumes, axis=0)) if opacities else None


def plot_figure(groups: Sequence[Group], path: Path) -> None:
    """Draw Figure 4, a row for each group."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 3.6 * len(groups)), layout="constrained")
    for group, (left, right) in zip(groups, figure.subplots(len(groups), 2, squeeze=False), strict=True):
        for way, share in WAYS.figure_4:
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
    with replacing(path, named=False) as part:
        figure.savefig(part, dpi=110, format="png")


def _extent(group: Group) -> tuple[float, float]:
    """Range of log10 of the volume over the bins with more than 0.1 % of the Gaussians."""
    found = [both[1] for way, share in WAYS.figure_4 if (both := densities(group, way.name, share)) is not None]
    filled: np.ndarray = np.flatnonzero(np.max(found, axis=0) > 1e-3) if found else np.empty(0, int)
    edges = BINS.volume_edges
    return (edges[filled[0]], edges[filled[-1] + 1]) if len(filled) else BINS.volume_span


def _stairs(axis: Axes, shares: np.ndarray, edges: np.ndarray, way: Way) -> None:
    colors = {"lightgaussian": "tab:orange", "pup": "gray", "paper": "tab:blue", "merge": "tab:green", "dense": "black"}
    style = "--" if way == WAYS.dense else "-"
    axis.stairs(100 * shares, edges, color=colors[way.name], linestyle=style, label=way.label, linewidth=1.4)


def _median(shares: np.ndarray, edges: np.ndarray) -> float:
    below = np.concatenate([[0.0], np.cumsum(shares)])  # share of the Gaussians below each edge
    return float(np.interp(0.5 * below[-1], below, edges))
