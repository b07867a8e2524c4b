"""Command lines of ``ns-train`` and ``ns-eval``, their running, and which trainings have finished.

nerfstudio is not imported.
"""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
import threading
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.runs import METHOD_NAMES, open_run
from pointsplat_ns.nerfstudio_plugin.registration import JIT_SCRIPT

TrainOptions = Mapping[str, Any]
"""Option name without its dashes -> value. A tuple or list becomes several words."""


class StoppedError(Exception):
    """Work in a thread that was stopped because the whole program is."""


def has_finished(run: Path, steps: int) -> bool:
    """Whether the training in a run's folder, which need not exist, has finished. A SceneError if a training of another
    number of steps has finished there."""
    done = _steps_if_finished(run)
    if done is not None and done != steps:
        wanted = f"expected one of {steps} or none"
        raise SceneError(f"{run}: holds a finished training of {done} steps; {wanted}; name another --output")
    return done is not None


def remove_interrupted(run: Path) -> None:
    """Remove the folder of an interrupted training, if there is one: the next training would leave its old checkpoints
    beside the new ones. Raises SceneError if the training there has finished."""
    if _steps_if_finished(run) is not None:
        raise SceneError(f"{run}: holds a finished training; expected an interrupted one or none; remove it yourself")
    shutil.rmtree(run, ignore_errors=True)


def _steps_if_finished(run: Path) -> int | None:
    try:
        known = open_run(run, need_data=False)
    except SceneError:  # no folder, or no checkpoint yet
        return None
    return None if known.planned_steps is not None and known.step + 1 < known.planned_steps else known.step + 1


def run(command: str, log: Path | None = None, threads: int | None = None, stop: threading.Event | None = None) -> None:
    """Print a command and run it, with the program from this Python's environment. If this is interrupted, the command
    is ended first.

    Args:
        command: the command line.
        log: file for the command's output; by default the output is shown here.
        threads: number of threads that torch may use in it; by default torch decides.
        stop: ends the command when it is set, as Ctrl-C does in the main thread.

    Raises:
        PointSplatError: if the command fails.
        StoppedError: if ``stop`` is set.
    """
    print(f"\n$ {command}", flush=True)
    program, *arguments = shlex.split(command)
    beside = Path(sys.executable).parent / program
    # Waiting OpenMP threads spin for some microseconds, then sleep. By default they keep spinning, which on a busy
    # machine slows the thread that they wait for. Threads that sleep at once (OMP_WAIT_POLICY=PASSIVE) wake too late.
    environment = {"GOMP_SPINCOUNT": "20000", "PYTHONWARNINGS": JIT_SCRIPT, **os.environ}
    if threads is not None:
        environment["OMP_NUM_THREADS"] = str(threads)
    words = [str(beside) if beside.exists() else program, *arguments]
    if log is None:
        status, where = _status(words, environment, None, stop), "what it said is above"
    else:
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("wb") as stream:
            status = _status(words, environment, stream, stop)
        where = f"what it said is in {log}"
    if status != 0:
        raise PointSplatError(f"{command}: ended with exit status {status}; {where}")


def _status(
    words: list[str], environment: dict[str, str], output: BinaryIO | None, stop: threading.Event | None
) -> int:
    """Run a program until it ends, and give its exit status. It does not outlive an exception here."""
    errors = None if output is None else subprocess.STDOUT
    # A session of its own: Ctrl-C would reach it twice, and a training saves its last step on the first signal alone.
    with subprocess.Popen(words, env=environment, stdout=output, stderr=errors, start_new_session=True) as process:
        try:
            while stop is None or not stop.is_set():
                try:
                    return process.wait(None if stop is None else 0.2)  # s between looks at whether it shall stop
                except subprocess.TimeoutExpired:
                    continue
            raise StoppedError(shlex.join(words))
        except BaseException:
            process.terminate()
            try:
                process.wait(600.0)  # s to end a step and save after the signal
            except BaseException:  # also a second Ctrl-C
                process.kill()
            raise


def train_scene_command(
    data: Path,
    output: Path,
    name: str,
    steps: int,
    timestamp: str,
    seed_points: int,
    options: TrainOptions | None = None,
) -> str:
    """The command that trains a Splatfacto scene from a folder in the Replica layout. The run goes to
    :func:`folder_of_run`. The scene starts from ``seed_points`` points of the depth images; ``options`` are more
    options of the method."""
    words = _train_words(METHOD_NAMES.scene, output, name, steps, timestamp, options)
    return shlex.join([*words, "--data", str(data), "replica-data", "--num-seed-points", str(seed_points)])


def train_refiner_command(
    scenes: Path,
    output: Path,
    name: str,
    steps: int,
    timestamp: str,
    eval_scenes: tuple[str, ...] = (),
    options: TrainOptions | None = None,
    method: str = METHOD_NAMES.refiner,
) -> str:
    """The command that trains a refiner on all scenes below the folder ``scenes``, but for those named in
    ``eval_scenes``, by a method or a preset of it. The run goes to :func:`folder_of_run`; ``options`` are further ones
    of the method."""
    held_out = {"pipeline.datamanager.eval-scenes": eval_scenes} if eval_scenes else {}
    options = {"data": scenes, **held_out, **(options or {})}
    return shlex.join(_train_words(method, output, name, steps, timestamp, options))


def evaluate_command(run: Path, evaluation: Path, pictures: Path) -> str:
    """The command that evaluates a run on the held-out views of its scenes: the JSON file to write, and a folder for
    images."""
    words = ["ns-eval", "--load-config", str(run / "config.yml"), "--output-path", str(evaluation)]
    return shlex.join([*words, "--render-output-path", str(pictures)])


def folder_of_run(output: Path, name: str, method: str, timestamp: str) -> Path:
    """The folder in which nerfstudio saves a run."""
    return output / name / method / timestamp


def _train_words(
    method: str, output: Path, name: str, steps: int, timestamp: str, options: TrainOptions | None
) -> list[str]:
    words = ["ns-train", method, "--vis", "tensorboard", "--timestamp", timestamp, "--output-dir", str(output)]
    words += ["--experiment-name", name, "--max-num-iterations", str(steps)]
    for option, value in (options or {}).items():
        words += [f"--{option}", *map(_word, value if isinstance(value, (tuple, list)) else (value,))]
    return words


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
