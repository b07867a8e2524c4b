"""Writes tables as Markdown and as LaTeX."""

from __future__ import annotations

import re
from collections.abc import Sequence

from pointsplat_ns.tables.layout import Row, Table


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
    escaped = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
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
