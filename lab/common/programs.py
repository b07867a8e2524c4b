"""Runs other programs, and measures their time and memory as the system counts them."""

from __future__ import annotations

import json
import os
import shlex
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.errors import PointSplatError

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
"""Starts a program and waits for it, in a small interpreter of its own: on Linux a process begins
with the peak memory of the one that started it, which is one that holds scenes."""


@dataclass(frozen=True)
class Usage:
    """Time and memory of a program."""

    seconds: float
    cpu_seconds: float | None
    """Of all its threads, and of the processes that it started and waited for."""
    peak_bytes: int | None
    """Most resident memory, of the largest of these processes."""


class ProgramFailed(PointSplatError):
    """A program did not do what it was started for."""


def run_measured(args: Sequence[str], timeout: float | None = None) -> Usage:
    """Run a program to its end, without a shell; what it prints is kept for the error. After
    ``timeout`` seconds it is ended, with all that it started. Raises ProgramFailed if it cannot be
    started, is killed, takes too long or ends with another status than 0.

    Example:
        >>> run_measured([sys.executable, "-c", "pass"]).seconds > 0
        True
    """
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "usage.json"
        watch = [sys.executable, "-I", "-S", "-c", WATCH, str(report), *args]
        status, said = _run(watch, shlex.join(args), timeout)
        found = json.loads(report.read_text("utf-8")) if report.is_file() else {"exit": status}
    status = found.pop("exit")
    if status != 0:
        end = f"was killed by signal {-status}" if status < 0 else f"ended with status {status}"
        raise ProgramFailed(f"{shlex.join(args)} {end}: {' '.join(said.split())[-300:]}")
    return Usage(**found)


def _run(args: Sequence[str], name: str, timeout: float | None) -> tuple[int, str]:
    """The exit status of a program and what it printed. Whatever ends the wait, nothing that it
    started is left."""
    pipe = subprocess.PIPE
    # A session of its own, so that it can be ended together with the programs that it starts.
    with subprocess.Popen(
        args,
        stdin=subprocess.DEVNULL,
        stdout=pipe,
        stderr=pipe,
        text=True,
        errors="replace",
        start_new_session=True,
    ) as process:
        try:
            printed, complained = process.communicate(timeout=timeout)
        except subprocess.TimeoutExpired as error:
            raise ProgramFailed(f"{name} took more than {timeout:g} s and was ended") from error
        finally:
            if process.returncode is None:
                with suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
        return process.returncode, complained or printed
