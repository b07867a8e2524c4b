"""splat-transform's decimation, the peer of merging: a Node package, used where it is installed."""

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


@dataclass(frozen=True)
class Reducer:
    """A program that reads a PLY and writes a smaller one."""

    label: str
    command: Callable[[Path, int, Path], list[str]]
    """The command line for a PLY to read, a number of Gaussians, and a PLY to write."""

    def reduce(self, source: Path, count: int, timeout: float | None = None) -> tuple[Gaussians, Usage]:
        """Run the program on a PLY, to keep ``count`` Gaussians: the smaller scene, and the cost with reading and
        writing. No file is left beside the PLY. Raises ProgramFailed if it fails, takes longer than ``timeout`` seconds
        or writes no file, and SceneError if its file cannot be read."""
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
        modes: its modes of decimation: ``--decimate``, and from version 3 on ``--decimate-adaptive``.

    Args:
        program: the path of the program; by default ``npx --no-install splat-transform`` searches it.
    """

    def __init__(self, program: str | None = None):
        self.command = [program] if program else ["npx", "--no-install", NAME]
        self.version = self.missing = ""
        self.modes: tuple[Reducer, ...] = ()
        try:
            found = subprocess.run(
                [*self.command, "--version"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120
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
        if int(version[2]) < 3:
            self.modes = (self._mode(label, "--decimate"),)
        else:
            adaptive = self._mode(f"{label} adaptive", "--decimate-adaptive")
            self.modes = (self._mode(f"{label} -d", "--decimate"), adaptive)

    def _mode(self, label: str, option: str) -> Reducer:
        def command(source: Path, count: int, target: Path) -> list[str]:
            return [*self.command, "-w", "-g", "cpu", str(source), option, str(count), str(target)]

        return Reducer(label, command)
