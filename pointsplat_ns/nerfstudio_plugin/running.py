"""Runs command lines in other processes, and tells which trainings have finished."""

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
"""Lets waiting OpenMP threads spin for some microseconds, then sleep. By default they keep spinning, which on a busy
machine slows the thread that they wait for. Threads that sleep at once (OMP_WAIT_POLICY=PASSIVE) wake too late."""


def finished(run: Path, steps: int) -> bool:
    """Whether the training in a run's folder reached its last step. The folder of an interrupted one is removed."""
    try:
        if open_run(run, need_data=False).step == steps - 1:
            return True
    except SceneError:
        pass
    shutil.rmtree(run, ignore_errors=True)
    return False


def run(command: str, log: Path | None = None, threads: int | None = None) -> None:
    """Print a command and run it, with the program from this Python's environment.

    Args:
        command: the command line.
        log: file for the command's output; by default the output is shown here.
        threads: number of threads that torch may use in it; by default torch decides.

    Raises:
        PointSplatError: if the command fails.
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
