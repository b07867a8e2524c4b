"""The programs of this package that make a PLY smaller."""

from __future__ import annotations

import sys
from pathlib import Path

from pointsplat_ns.tables.splat_transform import Reducer


def pointsplat_prune(method: str) -> Reducer:
    """``pointsplat prune --by METHOD``, by the interpreter in use."""
    program = [sys.executable, "-c", "from pointsplat_ns.cli import main; main()"]

    def command(source: Path, count: int, target: Path) -> list[str]:
        return [*program, "prune", str(source), "--keep", str(count), "--by", method, "-o", str(target)]

    return Reducer(method, command)
