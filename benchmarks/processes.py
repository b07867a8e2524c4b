"""The programs of this package that make a PLY smaller."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

from pointsplat_ns.tables.splat_transform import Reducer

COMPACT = "compact"
"""Label of ``pointsplat compact`` with its defaults."""

Way = Literal["prune", "compact", "thorough"]

WAYS: dict[Way, tuple[str, ...]] = {
    "prune": ("prune",),
    "compact": ("compact",),
    "thorough": ("compact", "--effort", "thorough"),
}
"""What users of the program give to make a scene smaller, but for the scene and the budget."""

_PROGRAM = [sys.executable, "-c", "from pointsplat_ns.cli import main; main()"]


def pointsplat_prune(method: str) -> Reducer:
    """``pointsplat prune --by METHOD``, by the interpreter in use."""
    return _pointsplat(method, "prune", "--by", method)


def pointsplat_compact() -> Reducer:
    """``pointsplat compact`` with its defaults, by the interpreter in use."""
    return _pointsplat(COMPACT, "compact")


def pointsplat_way(way: Way) -> Reducer:
    """One of the :data:`WAYS`, by the interpreter in use."""
    return _pointsplat(way, *WAYS[way])


def count_of(keep: float, gaussians: int) -> int:
    """The number that a share means; every program is given the number."""
    return max(1, round(keep * gaussians))


def _pointsplat(label: str, name: str, *options: str) -> Reducer:
    def command(source: Path, count: int, target: Path) -> list[str]:
        return [*_PROGRAM, name, str(source), "--keep", str(count), *options, "-o", str(target)]

    return Reducer(label, command)
