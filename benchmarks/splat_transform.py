"""splat-transform's decimation, the peer of merging: a Node package that is run if it can be had."""

from __future__ import annotations

import subprocess
from pathlib import Path

from processes import Reducer

NAME = "splat-transform"

UNIFORM, ADAPTIVE = "--decimate", "--decimate-adaptive"
ADAPTIVE_SINCE = 3
"""The major version that came with the second mode."""


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
            found = subprocess.run([*self.command, "--version"], capture_output=True, text=True, timeout=120)
        except (OSError, subprocess.TimeoutExpired) as error:
            self.missing = f"{self.command[0]}: {error.__class__.__name__}"
            return
        words = (found.stdout + found.stderr).split()
        self.version = next((word[1:] for word in words if word[:1] == "v" and word[1:2].isdigit()), "")
        if found.returncode != 0 or not self.version:
            self.missing = f"{' '.join(self.command)} ended with {found.returncode}; is Node's package installed?"
            return
        label = f"{NAME} {self.version}"
        if int(self.version.split(".")[0]) < ADAPTIVE_SINCE:
            self.modes = (self._mode(label, UNIFORM),)
        else:
            self.modes = (self._mode(f"{label} -d", UNIFORM), self._mode(f"{label} adaptive", ADAPTIVE))

    def _mode(self, label: str, option: str) -> Reducer:
        def command(source: Path, count: int, target: Path) -> list[str]:
            return [*self.command, "-w", "-g", "cpu", str(source), option, str(count), str(target)]

        return Reducer(label, command)


def peers_of(programs: tuple[str, ...]) -> tuple[list[Reducer], str]:
    """The modes of every program named, and why there are none.

    Args:
        programs: paths; none means what npx finds, which may be nothing.

    Raises:
        SystemExit: if a program that was named cannot be run.
    """
    if not programs:
        found = SplatTransform()
        return list(found.modes), found.missing
    modes: list[Reducer] = []
    for program in programs:
        found = SplatTransform(program)
        if found.missing:
            raise SystemExit(f"{NAME}: {found.missing}")
        modes += [mode for mode in found.modes if mode.label not in [known.label for known in modes]]
    return modes, ""
