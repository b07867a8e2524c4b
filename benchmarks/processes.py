"""The programs of this package that make a PLY smaller."""

from __future__ import annotations

import sys
from pathlib import Path

from pointsplat_ns.tables.splat_transform import Reducer

COMPACT = "compact"
"""Label of ``pointsplat compact`` with its defaults."""

_PROGRAM = [sys.executable, "-c", "from pointsplat_ns.cli import main; main()"]


def pointsplat_prune(method: str) -> Reducer:
    """``pointsplat prune --by METHOD``, by the interpreter in use."""
    return _pointsplat(method, "prune", "--by", method)


def pointsplat_compact() -> Reducer:
    """``pointsplat compact`` with its defaults, by the interpreter in use."""
    return _pointsplat(COMPACT, "compact")


def _pointsplat(label: str, name: str, *options: str) -> Reducer:
    def command(source: Path, count: int, target: Path) -> list[str]:
        return [*_PROGRAM, name, str(source), "--keep", str(count), *options, "-o", str(target)]

    return Reducer(label, command)
