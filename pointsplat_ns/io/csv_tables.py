"""Tables that spreadsheets open."""

from __future__ import annotations

import csv
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pointsplat_ns.io.files import replacing

_FORMULA = tuple("=+-@\t\r\n\N{FULLWIDTH EQUALS SIGN}\N{FULLWIDTH PLUS SIGN}\N{FULLWIDTH HYPHEN-MINUS}") + (
    "\N{FULLWIDTH COMMERCIAL AT}",
)
"""Signs by which spreadsheets tell a formula, which may send what stands in other cells (OWASP, CSV injection)."""


def write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Write rows of the same columns to a CSV file, as :func:`~pointsplat_ns.io.files.replacing` writes what no
    person named.

    A text that a spreadsheet would take for a formula gets a leading apostrophe, as a file's name may be a stranger's.
    """
    with replacing(path, named=False) as part, part.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(rows[0]))
        writer.writeheader()
        writer.writerows({name: _as_text(value) for name, value in row.items()} for row in rows)


def _as_text(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value
