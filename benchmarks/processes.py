"""Time and memory of other programs, as the system counts them, and the programs that make a PLY smaller."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import read_ply

WATCH = """
import json, os, sys, time
start = time.perf_counter()
child = os.posix_spawnp(sys.argv[2], sys.argv[2:], os.environ)
_, status, used = os.wait4(child, 0)
seconds = time.perf_counter() - start
unit = 1 if sys.platform == "darwin" else 1024  # of ru_maxrss, bytes
found = {"exit": os.waitstatus_to_exitcode(status), "seconds": seconds,
         "cpu_seconds": used.ru_utime + used.ru_stime, "peak_bytes": unit * used.ru_maxrss}
with open(sys.argv[1], "w") as stream:
    json.dump(found, stream)
"""
"""Starts a program and waits for it, in a small interpreter of its own: on Linux a process begins with the peak memory
of the one that started it, which is a benchmark that holds scenes."""


@dataclass(frozen=True)
class Usage:
    """What a program took."""

    seconds: float
    cpu_seconds: float | None
    """Of all its threads, and of the processes that it started and waited for."""
    peak_bytes: int | None
    """Most resident memory, of the largest of these processes."""


class ProgramFailed(RuntimeError):
    """A program did not do what it was started for."""


def run_measured(args: Sequence[str]) -> Usage:
    """Run a program to its end; what it prints is kept for the error.

    Raises:
        ProgramFailed: if it cannot be started, is killed or ends with another status than 0.
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "usage.json"
        watch = [sys.executable, "-I", "-S", "-c", WATCH, str(report), *args]
        done = subprocess.run(watch, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace")
        found = json.loads(report.read_text("utf-8")) if report.is_file() else {"exit": done.returncode}
    status = found.pop("exit")
    if status != 0:
        end = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        raise ProgramFailed(f"{shlex.join(args)} {end}: {(done.stderr or done.stdout).strip()[-300:]}")
    return Usage(**found)


@dataclass(frozen=True)
class Reducer:
    """A program that reads a PLY and writes a smaller one."""

    label: str
    command: Callable[[Path, int, Path], list[str]]
    """The command line for a PLY to read, a number of Gaussians, and a PLY to write."""

    def reduce(self, source: Path, count: int) -> tuple[Gaussians, Usage]:
        """What the program makes of a PLY, and what it took, with reading and writing.

        Raises:
            ProgramFailed: if it fails or writes no file.
        """
        with tempfile.TemporaryDirectory(dir=source.parent) as folder:
            target = Path(folder) / "small.ply"
            args = self.command(source, count, target)
            usage = run_measured(args)
            if not target.is_file():
                raise ProgramFailed(f"{shlex.join(args)} ended well but wrote no file")
            return read_ply(target), usage


def pointsplat_prune(method: str) -> Reducer:
    """``pointsplat prune --by METHOD``, by the interpreter in use."""
    program = [sys.executable, "-c", "from pointsplat_ns.cli import main; main()"]

    def command(source: Path, count: int, target: Path) -> list[str]:
        return [*program, "prune", str(source), "--keep", str(count), "--by", method, "-o", str(target)]

    return Reducer(method, command)
