"""Writes all cells of a folder: tables in Markdown and LaTeX, all figures in JSON, and Figure 4."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pointsplat_ns.io.files import replacing, write_json
from pointsplat_ns.tables.figure import medians, plot_figure
from pointsplat_ns.tables.layout import Layout, Table, figure_medians
from pointsplat_ns.tables.means import Group, read_groups
from pointsplat_ns.tables.paper import published
from pointsplat_ns.tables.ways import DENSE_WAY
from pointsplat_ns.tables.writing import latex_document, markdown_table, markdown_text
from pointsplat_ns.tradeoff.machine import is_busy

OUTPUTS = ("tables.md", "tables.tex", "tables.json", "figure4.png")
"""Names of the written files."""

READING = (
    "Figures are means over scenes. PSNR (dB), SSIM and LPIPS (AlexNet) are against held-out photos; those of "
    '"renders" against the dense scene\'s own renders in the same poses. "Loses most" names the scene that loses most '
    "PSNR compared to its dense scene, with its PSNR and the difference; among dense scenes it is the one of the least "
    "PSNR. \\*: nothing is fine-tuned or refined."
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
    write_json(_content(groups, missing), folder / "tables.json")
    with replacing(folder / "tables.md") as part:
        part.write_text(_markdown(groups, tables), encoding="utf-8")
    with replacing(folder / "tables.tex") as part:
        every = [table for members in tables.values() for table in members]
        part.write_text(latex_document(every, [READING.replace("\\", ""), *_notes(groups)]), encoding="utf-8")
    plot_figure(groups, folder / "figure4.png")
    return groups


def _markdown(groups: Sequence[Group], tables: Mapping[str, Sequence[Table]]) -> str:
    lines = [READING, "", *(line for note in _notes(groups) for line in (markdown_text(note), ""))]
    for group in groups:
        lines += [f"## {markdown_text(group.name)}", ""]
        lines += ["| scene | Gaussians | judged in | size |", "|---|---|---|---|"]
        for scene in group.scenes:
            about, dense = scene.about, scene.cells.get((DENSE_WAY.name, 1.0))
            words = (
                about.name,
                "-" if dense is None else f"{dense.point.gaussians:,}",
                f"{about.views} {about.origin}",
                f"{about.width} x {about.height}",
            )
            lines.append("| " + " | ".join(map(markdown_text, words)) + " |")
        lines += ["", *(markdown_table(table) for table in tables[group.name])]
    lines += ["![Figure 4](figure4.png)", "", "*Figure 4: opacity and volume of the Gaussians kept.*", ""]
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
    if any(group.dataset for group in groups):
        notes.append(
            "The paper's Table 2 and Figure 4 do not say of which scenes they are, so nothing of theirs is shown "
            "beside ours."
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
        "paper": {group.name: _published(group) for group in groups if group.dataset},
        "not_measured": dict(missing),
    }


def _published(group: Group) -> dict[str, Any]:
    """The paper's figures for a group of the same dataset, by table, way and share."""
    found: dict[str, Any] = {}
    for number in (1, 3, 4):
        for way, share in sorted({key for scene in group.scenes for key in scene.cells}):
            quality = published(number, group.dataset, way, share)
            if quality is not None:
                found[f"table {number}, {way}, {100 * share:g}%"] = dataclasses.asdict(quality)
    return found
