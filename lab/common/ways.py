"""The programs that make a PLY smaller: this package's commands, and splat-transform."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from lab.common.programs import ProgramFailed, Usage, run_measured
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import read_ply

Way = Literal["prune", "memory", "compact", "thorough"]

WAYS: dict[Way, tuple[str, ...]] = {
    "prune": ("prune",),
    "memory": ("prune", "--memory", "2GB"),
    "compact": ("compact",),
    "thorough": ("compact", "--effort", "thorough"),
}
"""What users of the program give to make a scene smaller, but for the scene and the budget."""

_PROGRAM = [sys.executable, "-c", "from pointsplat_ns.cli import program; program()"]

PEER = "splat-transform"
"""Name of the other program that is measured."""


@dataclass(frozen=True)
class Reducer:
    """A program that reads a PLY and writes a smaller one."""

    label: str
    command: Callable[[Path, int, Path], list[str]]
    """The command line for a PLY to read, a number of Gaussians, and a PLY to write."""

    def reduce(
        self, source: Path, count: int, timeout: float | None = None
    ) -> tuple[Gaussians, Usage]:
        """Run the program on a PLY, to keep ``count`` Gaussians: the smaller scene, and the cost
        with reading and writing. No file is left beside the PLY. Raises ProgramFailed if it fails,
        takes longer than ``timeout`` seconds or writes no file, and SceneError if its file cannot
        be read."""
        with tempfile.TemporaryDirectory(dir=source.parent) as folder:
            target = Path(folder) / "small.ply"
            args = self.command(source, count, target)
            usage = run_measured(args, timeout)
            if not target.is_file():
                raise ProgramFailed(f"{shlex.join(args)} ended well but wrote no file")
            return read_ply(target), usage


class SplatTransform:
    """splat-transform on the CPU.

    Attributes:
        version: such as "3.7.0".
        missing: the reason why it cannot be run; empty if it can.
        modes: its modes of decimation: ``--decimate``, and from version 3 on
            ``--decimate-adaptive``.

    Args:
        program: the path of the program; by default the one of this name on PATH. npx would run one
            of the current folder, which may be a stranger's.
    """

    def __init__(self, program: str | None = None):
        name = PEER
        self.command = [program or shutil.which(name) or name]
        self.version = self.missing = ""
        self.modes: tuple[Reducer, ...] = ()
        try:
            found = subprocess.run(
                [*self.command, "--version"],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=120,
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            self.missing = f"{self.command[0]}: {error.__class__.__name__}"
            return
        version = re.search(
            r"(?:^|\s)v((\d{1,6})\.[\w.+-]{1,40})(?=\s|$)", found.stdout + found.stderr
        )
        if found.returncode != 0 or version is None:
            self.missing = (
                f"{' '.join(self.command)} ended with {found.returncode}; is Node's package "
                "installed?"
            )
            return
        self.version = version[1]
        label = f"{name} {self.version}"
        if int(version[2]) < 3:
            self.modes = (self._mode(label, "--decimate"),)
        else:
            adaptive = self._mode(f"{label} adaptive", "--decimate-adaptive")
            self.modes = (self._mode(f"{label} -d", "--decimate"), adaptive)

    def _mode(self, label: str, option: str) -> Reducer:
        def command(source: Path, count: int, target: Path) -> list[str]:
            return [*self.command, "-w", "-g", "cpu", str(source), option, str(count), str(target)]

        return Reducer(label, command)


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
        programs += [
            mode for mode in found.modes if mode.label not in [known.label for known in programs]
        ]
    return programs


def count_of(keep: float, gaussians: int) -> int:
    """The number that a share means; every program is given the number."""
    return max(1, round(keep * gaussians))


def pointsplat_command(way: Way, source: Path, keep: str, target: Path) -> list[str]:
    """The command line of one of our ways."""
    name, *options = WAYS[way]
    return [*_PROGRAM, name, str(source), "--keep", keep, *options, "-o", str(target)]


def _pointsplat(way: Way) -> Reducer:
    return Reducer(
        way, lambda source, count, target: pointsplat_command(way, source, str(count), target)
    )
