"""The programs that make a PLY smaller: this package's commands, and splat-transform."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Literal

from lab.tables.making import Reducer, SplatTransform

Way = Literal["prune", "compact", "thorough"]

WAYS: dict[Way, tuple[str, ...]] = {
    "prune": ("prune",),
    "compact": ("compact",),
    "thorough": ("compact", "--effort", "thorough"),
}
"""What users of the program give to make a scene smaller, but for the scene and the budget."""

_PROGRAM = [sys.executable, "-c", "from pointsplat_ns.cli import program; program()"]

PEER = "splat-transform"
"""Name of the other program that is measured."""


def programs_of(ways: tuple[Way, ...], splat_transform: tuple[str, ...]) -> list[Reducer]:
    """Our ways, by the interpreter in use, and every mode of each named program of splat-transform.

    Raises:
        SystemExit: if a program that was named cannot be run.
    """
    programs = [_pointsplat(way) for way in ways]
    for path in splat_transform:
        found = SplatTransform(path)
        if found.missing:
            raise SystemExit(f"{PEER}: {found.missing}")
        programs += [mode for mode in found.modes if mode.label not in [known.label for known in programs]]
    return programs


def count_of(keep: float, gaussians: int) -> int:
    """The number that a share means; every program is given the number."""
    return max(1, round(keep * gaussians))


def pointsplat_command(way: Way, source: Path, keep: str, target: Path) -> list[str]:
    """The command line of one of our ways."""
    name, *options = WAYS[way]
    return [*_PROGRAM, name, str(source), "--keep", keep, *options, "-o", str(target)]


def _pointsplat(way: Way) -> Reducer:
    return Reducer(way, lambda source, count, target: pointsplat_command(way, source, str(count), target))
