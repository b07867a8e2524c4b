"""The ``ns-train`` and ``ns-eval`` command lines that this package runs. nerfstudio is not imported."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pointsplat_ns.io.runs import REFINER_METHOD

SCENE_METHOD = "splatfacto-cpu"
"""nerfstudio's name of the method that trains scenes."""

Options = Mapping[str, Any]
"""Option name without its dashes -> value. A tuple or list becomes several words."""


def train_scene_command(
    data: Path, output: Path, name: str, steps: int, timestamp: str, seed_points: int, options: Options | None = None
) -> str:
    """The command that trains a Splatfacto scene from a folder in the Replica layout. The run goes to
    :func:`run_folder`. The scene starts from ``seed_points`` points of the depth images; ``options`` are further ones
    of the method."""
    words = _train_words(SCENE_METHOD, output, name, steps, timestamp, options)
    return shlex.join([*words, "--data", str(data), "replica-data", "--num-seed-points", str(seed_points)])


def train_refiner_command(
    scenes: Path,
    output: Path,
    name: str,
    steps: int,
    timestamp: str,
    eval_scenes: tuple[str, ...] = (),
    options: Options | None = None,
) -> str:
    """The command that trains a refiner on all scenes below the folder ``scenes``, but for those named in
    ``eval_scenes``. The run goes to :func:`run_folder`; ``options`` are further ones of the method."""
    held_out = {"pipeline.datamanager.eval-scenes": eval_scenes} if eval_scenes else {}
    options = {"data": scenes, **held_out, **(options or {})}
    return shlex.join(_train_words(REFINER_METHOD, output, name, steps, timestamp, options))


def evaluate_command(run: Path, evaluation: Path, pictures: Path) -> str:
    """The command that evaluates a run on the held-out views of its scenes: the JSON file to write, and a folder for
    images."""
    words = ["ns-eval", "--load-config", str(run / "config.yml"), "--output-path", str(evaluation)]
    return shlex.join([*words, "--render-output-path", str(pictures)])


def run_folder(output: Path, name: str, method: str, timestamp: str) -> Path:
    """The folder in which nerfstudio saves a run."""
    return output / name / method / timestamp


def _train_words(
    method: str, output: Path, name: str, steps: int, timestamp: str, options: Options | None
) -> list[str]:
    words = ["ns-train", method, "--vis", "tensorboard", "--timestamp", timestamp, "--output-dir", str(output)]
    words += ["--experiment-name", name, "--max-num-iterations", str(steps)]
    for option, value in (options or {}).items():
        words += [f"--{option}", *map(_word, value if isinstance(value, (tuple, list)) else (value,))]
    return words


def _word(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
