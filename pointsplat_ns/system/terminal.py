"""What goes to the terminal: lines and tables that no name of a file can steer."""

from __future__ import annotations

import sys
from collections.abc import Collection, Iterable, Sequence

from pointsplat_ns.errors import printable


def say(*lines: object, error: bool = False, flush: bool = False) -> None:
    """Print lines on standard output, or on standard error. Control characters, which are those of
    names of files, and line breaks in a line are shown as Python writes them, such as ``\\x1b``."""
    for line in lines:
        print(printable(str(line)), file=sys.stderr if error else sys.stdout, flush=flush)


def print_table(
    header: Sequence[str],
    rows: Iterable[Sequence[str]],
    caption: str = "",
    title: str = "",
    left: Collection[int] = (0,),
    section: int = 0,
) -> None:
    """Print a table. Columns whose index is in ``left`` are left-aligned and may wrap; others are
    right-aligned. A line follows each ``section`` rows. Without a terminal, the table is as wide as
    its content."""
    from rich.console import Console
    from rich.markup import escape
    from rich.table import Table

    console = Console()
    if not console.is_terminal:
        console = Console(width=400)
    table = Table(
        title=escape(printable(title)) or None, caption=escape(printable(caption)) or None
    )
    for number, name in enumerate(map(escape, map(printable, header))):
        if number in left:
            table.add_column(name, overflow="fold")
        else:
            table.add_column(name, justify="right", no_wrap=True)
    for number, row in enumerate(rows, start=1):
        table.add_row(
            *(escape(printable(cell)) for cell in row),
            end_section=section > 0 and number % section == 0,
        )
    console.print(table)
