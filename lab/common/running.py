"""Command lines of ``ns-train``, and the running of commands. nerfstudio is not imported."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.registration import JIT_SCRIPT


def run(command: str, log: Path, show_errors: bool = False, **variables: str) -> None:
    """Print a command and run it, with the program from this Python's environment. If this is
    interrupted, the command is ended first.

    Args:
        command: the command line.
        log: file for its output.
        show_errors: leave its standard error on the terminal.
        variables: of its environment, where they are not set.

    Raises:
        PointSplatError: if the command fails.
    """
    print(f"\n$ {command}", flush=True)
    program, *arguments = shlex.split(command)
    beside = Path(sys.executable).parent / program
    words = [str(beside) if beside.exists() else program, *arguments]
    # Waiting OpenMP threads spin for some microseconds, then sleep. By default they keep spinning,
    # which on a busy machine slows the thread that they wait for. Threads that sleep at once
    # (OMP_WAIT_POLICY=PASSIVE) wake too late.
    environment = {
        "GOMP_SPINCOUNT": "20000",
        "PYTHONWARNINGS": JIT_SCRIPT,
        **variables,
        **os.environ,
    }
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("wb") as stream:
        status = _status(
            words, env=environment, stdout=stream, stderr=None if show_errors else subprocess.STDOUT
        )
    if status != 0:
        where = "above and in" if show_errors else "in"
        raise PointSplatError(
            f"{command}: ended with exit status {status}; what it said is {where} {log}"
        )


def _status(words: list[str], **options: Any) -> int:
    """Run a program until it ends, and give its exit status. It does not outlive an exception
    here."""
    # A session of its own: Ctrl-C would reach it twice, and a training saves its last step on the
    # first signal alone.
    with subprocess.Popen(words, start_new_session=True, **options) as process:
        try:
            return process.wait()
        except BaseException:
            process.terminate()
            try:
                process.wait(600.0)  # s to end a step and save after the signal
            except BaseException:  # also a second Ctrl-C
                process.kill()
            raise


def train_refiner_command(
    scenes: Path,
    output: Path,
    name: str,
    steps: int,
    timestamp: str,
    eval_scenes: tuple[str, ...],
    options: Mapping[str, Any],
    method: str,
) -> str:
    """The command that trains a refiner on all scenes below the folder ``scenes``, but for those
    named in ``eval_scenes``, by a method or a preset of it. The run goes to :func:`folder_of_run`;
    ``options`` are further ones of the method, without their dashes."""
    words = [
        "ns-train",
        method,
        "--vis",
        "tensorboard",
        "--timestamp",
        timestamp,
        "--output-dir",
        str(output),
    ]
    words += ["--experiment-name", name, "--max-num-iterations", str(steps), "--data", str(scenes)]
    if eval_scenes:
        words += ["--pipeline.datamanager.eval-scenes", *eval_scenes]
    for option, value in options.items():
        words += [f"--{option}", f"{value:g}" if isinstance(value, float) else str(value)]
    return shlex.join(words)


def folder_of_run(output: Path, name: str, method: str, timestamp: str) -> Path:
    """The folder in which nerfstudio saves a run."""
    return output / name / method / timestamp
