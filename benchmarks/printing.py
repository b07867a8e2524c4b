"""The console that tables are printed on."""

from __future__ import annotations

import sys

from rich.console import Console


def console() -> Console:
    """Wide enough for the tables where standard output is a file."""
    return Console(width=None if sys.stdout.isatty() else 240)
