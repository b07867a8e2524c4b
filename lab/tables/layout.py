"""Arranges means as the paper's tables: rows of text, and writes them as Markdown and as LaTeX."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from lab.tables.means import Group, Mean
from lab.tables.ways import PROTOCOL, WAYS, Way, cell_key, published
from pointsplat_ns.io.files import three_digits
from pointsplat_ns.tradeoff.points import ImageMetrics

NO_FIGURE = "-"
"""Text of an empty cell."""

OTHER_SCENES = "†"
"""Mark of a row whose means are over other scenes than those of the table."""

Row = tuple[str, ...]


@dataclass(frozen=True)
class Table:
    """One of the paper's tables for one group of scenes."""

    number: int
    title: str
    header: Row
    sections: tuple[tuple[Row, ...], ...]
    """Rows, in sections with a line between them."""
    notes: tuple[str, ...] = ()
    """Lines below the table: missing cells, and the reasons."""


class Layout:
    """Makes the tables of a group. ``shares`` are those in Tables 1 and 2, to which the shares of measured cells are
    added; ``missing`` has the reasons for missing cells, by key."""

    def __init__(self, group: Group, shares: Sequence[float], missing: Mapping[str, str]):
        self.group, self.missing = group, missing
        names = {way.name for way in WAYS.table_1} - {way.name for way in WAYS.table_4}  # Table 4 has other shares
        measured = {share for scene in group.scenes for way, share in scene.cells if way in names}
        self.shares = sorted({*shares, *measured}, reverse=True)

    def tables(self) -> list[Table]:
        """Tables 1 to 4."""
        return [self._table_1(), self._table_2(), self._table_3(), self._table_4()]

    def _table_1(self) -> Table:
        blocks = [[(WAYS.dense, 1.0)], *([(way, share) for way in WAYS.table_1] for share in self.shares)]
        sections = [[((_percent(share), way.label), way, share) for way, share in block] for block in blocks]
        return self._of_quality(1, "What is left at a number of Gaussians", ("kept", "method"), sections)

    def _table_2(self) -> Table:
        header = ("kept", "method", "Gaussians", "frames a second", "MB", "scenes")
        ways = WAYS.table_2
        blocks = [[(WAYS.dense, 1.0)], *([(way, share) for way in ways] for share in self.shares)]
        cells = [pair for block in blocks for pair in block]
        over = self._shared(cells)
        sections = []
        for block in blocks:
            rows = []
            for way, share in block:
                mean = self.group.mean(way.name, share, over)
                figures: Row = ("not measured", NO_FIGURE, NO_FIGURE, NO_FIGURE)
                if mean is not None:
                    figures = (
                        f"{mean.gaussians:,.0f}",
                        _fps(mean.fps),
                        three_digits(mean.megabytes),
                        _scenes(mean),
                    )
                rows.append((_percent(share), way.label, *figures))
            sections.append(tuple(rows))
        return Table(2, self._title("Efficiency", over), header, tuple(sections), self._notes(cells, over))

    def _table_3(self) -> Table:
        rows = [((f"{weight:g}", way.label), way, PROTOCOL.ablation_share) for weight, way in WAYS.table_3]
        sections = [rows[i : i + 2] for i in range(0, len(rows), 2)]
        title = f"Lambda of the paper's score, {_percent(PROTOCOL.ablation_share)} kept"
        return self._of_quality(3, title, ("lambda", "method"), sections)

    def _table_4(self) -> Table:
        branches = (("", "", ""), ("yes", "", ""), ("yes", "", "yes"), ("yes", "yes", ""), ("yes", "yes", "yes"))
        rows = [
            ((number, *used), way, PROTOCOL.ablation_share)
            for number, used, way in zip(("I", "II", "III", "IV", "V"), branches, WAYS.table_4, strict=True)
        ]
        first = ("model", "geometry", "appearance", "position")
        return self._of_quality(4, f"The dual-branch encoder, {_percent(PROTOCOL.ablation_share)} kept", first, [rows])

    def _of_quality(
        self, number: int, title: str, first: Row, sections: Sequence[Sequence[tuple[Row, Way, float]]]
    ) -> Table:
        """A table of PSNR, SSIM and LPIPS, with the paper's PSNR and SSIM where dataset and protocol are the paper's.
        Its LPIPS is by another network."""
        cells = [(way, share) for section in sections for _, way, share in section]
        over = self._shared(cells)
        dataset = self.group.comparable_dataset
        with_paper = any(published(number, dataset, way.name, share) for way, share in cells)
        metrics = ("PSNR", "SSIM", "LPIPS")
        header = first
        header += metrics if self.group.has_photos else ()
        header += tuple(f"{name} (renders)" for name in metrics)
        header += ("loses most", "scenes")
        header += tuple(f"{name} (paper)" for name in metrics[:2]) if with_paper else ()

        def row(words: Row, way: Way, share: float) -> Row:
            mean = self.group.mean(way.name, share, over)
            if mean is None:
                figures: Row = ("not measured",) + (NO_FIGURE,) * (7 if self.group.has_photos else 4)
            else:
                figures = _quality(mean.photos) if self.group.has_photos else ()
                figures += (*_quality(mean.renders), _worst(mean), _scenes(mean))
            theirs = _quality(published(number, dataset, way.name, share))[:2] if with_paper else ()
            return (*words, *figures, *theirs)

        rows = tuple(tuple(row(*entry) for entry in section) for section in sections)
        return Table(number, self._title(title, over), header, rows, self._notes(cells, over))

    def _title(self, what: str, over: frozenset[str]) -> str:
        return f"{what}: {self.group.name}, {_scenes_text(len(over))}"

    def _shared(self, cells: Sequence[tuple[Way, float]]) -> frozenset[str]:
        return self.group.shared((way.name, share) for way, share in cells)

    def _notes(self, cells: Sequence[tuple[Way, float]], over: frozenset[str]) -> tuple[str, ...]:
        """Lines below a table: rows of other scenes, the networks and steps of rows, and reasons for empty rows."""
        means = [self.group.mean(way.name, share, over) for way, share in cells]
        notes = []
        if any(mean is not None and not mean.comparable for mean in means):
            notes.append(
                f"{OTHER_SCENES}: not over the scenes of the other rows ({', '.join(sorted(over))}); its means do not "
                "compare with theirs"
            )
        return (*notes, *self._tools(cells), *self._reasons(cells))

    def _tools(self, cells: Sequence[tuple[Way, float]]) -> list[str]:
        """The networks, and the steps of fine-tuning, that rows were made with."""
        rows: dict[str, list[str]] = {}
        for way, share in cells:
            for scene in self.group.scenes:
                cell = scene.cells.get((way.name, share))
                if cell is not None and cell.made_with and (way.network is not None or way.fine_tuned):
                    row, labels = f"{way.label} ({_percent(share)})", rows.setdefault(cell.made_with, [])
                    labels += [] if row in labels else [row]
        return [f"{', '.join(labels)}: {made_with}" for made_with, labels in rows.items()]

    def _reasons(self, cells: Sequence[tuple[Way, float]]) -> tuple[str, ...]:
        """Reasons for empty rows and missing scenes, each once."""
        rows: dict[str, dict[str, list[str]]] = {}
        for way, share in cells:
            for scene in self.group.scenes:
                if (way.name, share) not in scene.cells:
                    why = self.missing.get(cell_key(scene.about.name, way, share), "not yet")
                    names = rows.setdefault(why, {}).setdefault(way.label, [])
                    names += [] if scene.about.name in names else [scene.about.name]
        everywhere, notes = len(self.group.scenes), []
        for why, by_label in rows.items():
            labels_by_place: dict[str, list[str]] = {}
            for label, names in by_label.items():
                place = "" if len(names) == everywhere else f" on {', '.join(names)}"
                labels_by_place.setdefault(place, []).append(label)
            notes += [f"Not measured{where}: {'; '.join(labels)}: {why}" for where, labels in labels_by_place.items()]
        return tuple(notes)


def figure_medians(group: Group, medians: Mapping[str, tuple[float, float]]) -> Table:
    """The medians of Figure 4, of opacity and of log10 of the volume by name of the way, as a table."""
    rows = tuple(
        (way.label, f"{medians[way.name][0]:.2f}", f"{medians[way.name][1]:.1f}")
        for way, _ in WAYS.figure_4
        if way.name in medians
    )
    title = f"Medians of Figure 4: {group.name}, {_percent(PROTOCOL.figure_share)} kept"
    return Table(0, title, ("method", "opacity", "log10 of the volume"), (rows,))


def _scenes(mean: Mean) -> str:
    return f"{mean.scenes}" if mean.comparable else f"{mean.scenes} {OTHER_SCENES}"


def _scenes_text(count: int) -> str:
    return f"{count} scene{'s' if count != 1 else ''}"


def _percent(share: float) -> str:
    return f"{100 * share:g} %"


def _quality(quality: ImageMetrics | None) -> Row:
    if quality is None:
        return (NO_FIGURE,) * 3
    psnr = NO_FIGURE if math.isinf(quality.psnr) else f"{quality.psnr:.2f}"
    return psnr, f"{quality.ssim:.3f}", NO_FIGURE if quality.lpips is None else f"{quality.lpips:.3f}"


def _worst(mean: Mean) -> str:
    if math.isinf(mean.worst_psnr):
        return NO_FIGURE
    lost = "" if mean.worst_loss is None or mean.worst_loss == 0 else f" ({-mean.worst_loss:+.2f})"
    return f"{mean.worst} {mean.worst_psnr:.2f}{lost}"


def _fps(value: float | None) -> str:
    if value is None:
        return "busy"
    return f"{value:.3g}" if value < 100 else f"{value:.0f}"


def markdown_text(text: str) -> str:
    """Text with Markdown's special characters escaped.

    Example:
        >>> print(markdown_text("PointSplat* of room_1"))
        PointSplat\\* of room\\_1
    """
    return re.sub(r"([\\`*_{}\[\]<>#|~])", r"\\\1", " ".join(text.split()))


def latex_text(text: str) -> str:
    """Text with LaTeX's special characters escaped.

    Example:
        >>> print(latex_text("50 % of room_1"))
        50 \\% of room\\_1
    """
    escaped = {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        OTHER_SCENES: r"\textdagger{}",
    }
    escaped |= {character: f"\\{character}" for character in "&%$#_{}"}
    return "".join(escaped.get(character, character) for character in " ".join(text.split()))


def markdown_table(table: Table) -> str:
    """A table in Markdown, with its title above and its notes below."""
    name = f"Table {table.number}. " if table.number else ""
    lines = [f"**{name}{markdown_text(table.title)}**", ""]
    lines += [_line(table.header), "|" + "---|" * len(table.header)]
    lines += [_line(row) for section in table.sections for row in section]
    lines += ["", *(f"- {markdown_text(note)}" for note in table.notes)] if table.notes else []
    return "\n".join(lines) + "\n"


def _line(row: Row) -> str:
    return "| " + " | ".join(markdown_text(text) for text in row) + " |"


def latex_table(table: Table) -> str:
    """A table in LaTeX with the package ``booktabs``; the notes are comments."""
    columns = "".join("l" if i < 2 else "r" for i in range(len(table.header)))
    name = f"% Table {table.number} of the paper" if table.number else "%"
    lines = [name, r"\begin{table*}", r"\centering", rf"\caption{{{latex_text(table.title)}}}"]
    lines += [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", _latex_line(table.header)]
    for section in table.sections:
        lines += [r"\midrule", *map(_latex_line, section)]
    lines += [r"\bottomrule", r"\end{tabular}", *(f"% {' '.join(note.split())}" for note in table.notes)]
    return "\n".join([*lines, r"\end{table*}"]) + "\n"


def _latex_line(row: Row) -> str:
    return " & ".join(latex_text(text) for text in row) + r" \\"


def latex_document(tables: Sequence[Table], about: Sequence[str]) -> str:
    """All tables, for ``\\input``, with lines of text as comments at the beginning."""
    head = [f"% {' '.join(line.split())}" for line in about]
    return "\n".join([*head, r"% needs \usepackage{booktabs}", "", *map(latex_table, tables)])
