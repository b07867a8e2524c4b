"""Running command lines one after the other, so that what an interrupted one finished is not done again."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.runs import open_run
from pointsplat_ns.nerfstudio_plugin.third_party_warnings import PYTHONWARNINGS

SHORT_SPIN = {"GOMP_SPINCOUNT": "20000"}
"""OpenMP threads that wait spin for some microseconds, then sleep. By default they spin on, which on a busy machine
holds up the thread that they wait for; threads that sleep at once (OMP_WAIT_POLICY=PASSIVE) wake too late."""


def finished(run: Path, steps: int) -> bool:
    """Whether a run's training reached its last step; what an interrupted one left is removed."""
    try:
        if open_run(run, need_data=False).step == steps - 1:
            return True
    except SceneError:
        pass
    shutil.rmtree(run, ignore_errors=True)
    return False


def run(command: str, log: Path | None = None, threads: int | None = None) -> None:
    """Run a command of this Python's environment, shown as one would type it.

    Args:
        command: the command line.
        log: a file for what it says; by default that is shown here.
        threads: that torch may use in it; by default as many as it likes.

    Raises:
        PointSplatError: if it fails.
    """
    print(f"\n$ {command}", flush=True)
    program, *arguments = shlex.split(command)
    beside = Path(sys.executable).parent / program
    environment = {**SHORT_SPIN, "PYTHONWARNINGS": PYTHONWARNINGS, **os.environ}
    if threads is not None:
        environment["OMP_NUM_THREADS"] = str(threads)
    words = [str(beside) if beside.exists() else program, *arguments]
    if log is None:
        status, where = subprocess.run(words, env=environment).returncode, "what it said is above"
    else:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as stream:
            status = subprocess.run(words, env=environment, stdout=stream, stderr=subprocess.STDOUT).returncode
        where = f"what it said is in {log}"
    if status != 0:
        raise PointSplatError(f"{command}: ended with exit status {status}; {where}")
