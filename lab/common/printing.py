"""How programs start, print tables and draw figures."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro
from rich.console import Console
from rich.table import Table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDE = 240
"""Characters of a line where standard output is a file."""


def start(program: Callable[..., Any]) -> Any:
    """Run a function with the arguments of the command line; input that cannot be used ends it with
    one line."""
    from pointsplat_ns.errors import PointSplatError

    try:
        return tyro.cli(program, config=(tyro.conf.OmitArgPrefixes,))
    except PointSplatError as error:
        sys.exit(f"error: {error}")


def console() -> Console:
    """Wide enough for the tables where standard output is a file."""
    return Console(width=None if sys.stdout.isatty() else WIDE)


def table(
    title: str, heads: Sequence[str], rows: Iterable[Sequence[object]], left: Iterable[str] = ()
) -> Table:
    """A table for the console; the first column and those of ``left`` start at the left."""
    shown = Table(title=title)
    for i, head in enumerate(heads):
        shown.add_column(head, justify="left" if i == 0 or head in left else "right")
    for row in rows:
        shown.add_row(*map(str, row))
    return shown


def markdown(heads: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table.

    >>> print(markdown(["kept", "dB"], [["10 %", 30]]))
    | kept | dB |
    |---|---|
    | 10 % | 30 |
    """
    lines = ["| " + " | ".join(map(str, cells)) + " |" for cells in (heads, *rows)]
    return "\n".join([lines[0], "|" + "---|" * len(heads), *lines[1:]])


def put_between(text: str, new: str, path: Path, name: str) -> str:
    """A text in which a new part stands between ``<!-- name -->`` and ``<!-- /name -->``.

    Raises:
        SystemExit: if the text does not have both marks, once each and in order.
    """
    first = f"<!-- {name} -->"
    last = f"<!-- /{name} -->"
    if text.count(first) != 1 or text.count(last) != 1 or text.index(first) > text.index(last):
        raise SystemExit(f"{path}: expected {first} and then {last}, once each")
    before, rest = text.split(first)
    return f"{before}{first}\n\n{new}\n\n{last}{rest.split(last)[1]}"


def wrapped(text: str) -> str:
    """A paragraph of a page in lines of at most 120 characters."""
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def number(digits: int, scale: float = 1.0, sign: str = "") -> Callable[[float | None], str]:
    """How a column writes its numbers: digits after the point, a factor first, "+" for a sign
    always, a dash for None.

    >>> number(1, 1e3)(0.0123), number(2)(None)
    ('12.3', '-')
    """
    return lambda value: "-" if value is None else f"{scale * value:{sign},.{digits}f}"


def percent(share: float) -> str:
    """A share for people.

    >>> percent(0.1)
    '10 %'
    """
    return f"{100 * share:g} %"


megabytes = number(0, 1e-6)
"""Bytes as megabytes."""


def save_figure(figure: Figure, path: Path, **options: Any) -> None:
    """Write a picture whole or not at all, in the format that its name says."""
    from pointsplat_ns.system.files import replacing

    with replacing(path) as part:
        figure.savefig(part, **{"dpi": 110, "format": path.suffix.lstrip(".") or "png", **options})
    print(f"wrote {path}", flush=True)
