"""splat-transform's decimation, the peer of merging: a Node package that is run if it can be had."""

from __future__ import annotations

import subprocess
import time
from pathlib import Path

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import read_ply

NAME = "splat-transform"


class SplatTransform:
    """``splat-transform --decimate`` on the CPU. ``missing`` says why it cannot be run, and is empty if it can.

    Args:
        program: the path of the program; by default what ``npx --no-install splat-transform`` finds.
    """

    def __init__(self, program: str | None):
        self.command = [program] if program else ["npx", "--no-install", NAME]
        self.version = self.missing = ""
        try:
            found = subprocess.run([*self.command, "--version"], capture_output=True, text=True, timeout=120)
        except (OSError, subprocess.TimeoutExpired) as error:
            self.missing = f"{self.command[0]}: {error.__class__.__name__}"
            return
        words = (found.stdout + found.stderr).split()
        self.version = next((word for word in words if word[:1] == "v" and "." in word), "")
        if found.returncode != 0 or not self.version:
            self.missing = f"{' '.join(self.command)} ended with {found.returncode}; is Node's package installed?"

    @property
    def label(self) -> str:
        """Name and version."""
        return f"{NAME} {self.version}"

    def decimate(self, source: Path, count: int) -> tuple[Gaussians, float]:
        """The scene in a PLY reduced to ``count`` Gaussians, and seconds with reading and writing."""
        target = source.with_name(f"{source.stem}_{count}.ply")
        start = time.perf_counter()
        args = [*self.command, "-w", "-g", "cpu", str(source), "--decimate", str(count), str(target)]
        done = subprocess.run(args, capture_output=True, text=True)
        seconds = time.perf_counter() - start
        if not target.is_file():
            raise RuntimeError(f"{' '.join(args)}: {(done.stderr or done.stdout).strip()[-200:]}")
        decimated = read_ply(target)
        target.unlink()
        return decimated, seconds
