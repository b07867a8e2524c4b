"""splat-transform's decimation, the peer of merging: a Node package that is run if it can be had."""

from __future__ import annotations

import re
import shlex
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import read_ply
from pointsplat_ns.system.programs import ProgramFailed, Usage, run_measured

NAME = "splat-transform"

ANSWERS = 120.0
"""Seconds within which the program has to say its version; npx first looks for it."""

UNIFORM, ADAPTIVE = "--decimate", "--decimate-adaptive"
ADAPTIVE_SINCE = 3
"""The major version that came with the second mode."""


@dataclass(frozen=True)
class Reducer:
    """A program that reads a PLY and writes a smaller one."""

    label: str
    command: Callable[[Path, int, Path], list[str]]
    """The command line for a PLY to read, a number of Gaussians, and a PLY to write."""

    def reduce(self, source: Path, count: int, timeout: float | None = None) -> tuple[Gaussians, Usage]:
        """What the program makes of a PLY, and what it took, with reading and writing.

        Args:
            source: the PLY; nothing is left beside it.
            count: number of Gaussians to keep.
            timeout: seconds after which the program is ended.

        Raises:
            ProgramFailed: if it fails, takes too long or writes no file.
            SceneError: if what it wrote cannot be read.
        """
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
        missing: why it cannot be run; empty if it can.
        modes: its ways to make a PLY smaller: ``--decimate``, and from version 3 on ``--decimate-adaptive``.

    Args:
        program: the path of the program; by default what ``npx --no-install splat-transform`` finds.
    """

    def __init__(self, program: str | None = None):
        self.command = [program] if program else ["npx", "--no-install", NAME]
        self.version = self.missing = ""
        self.modes: tuple[Reducer, ...] = ()
        try:
            found = subprocess.run(
                [*self.command, "--version"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=ANSWERS
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            self.missing = f"{self.command[0]}: {error.__class__.__name__}"
            return
        version = re.search(r"(?:^|\s)v((\d{1,6})\.[\w.+-]{1,40})(?=\s|$)", found.stdout + found.stderr)
        if found.returncode != 0 or version is None:
            self.missing = f"{' '.join(self.command)} ended with {found.returncode}; is Node's package installed?"
            return
        self.version = version[1]
        label = f"{NAME} {self.version}"
        if int(version[2]) < ADAPTIVE_SINCE:
            self.modes = (self._mode(label, UNIFORM),)
        else:
            self.modes = (self._mode(f"{label} -d", UNIFORM), self._mode(f"{label} adaptive", ADAPTIVE))

    def _mode(self, label: str, option: str) -> Reducer:
        def command(source: Path, count: int, target: Path) -> list[str]:
            return [*self.command, "-w", "-g", "cpu", str(source), option, str(count), str(target)]

        return Reducer(label, command)
