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
    """The command that trains a Splatfacto scene from a folder in the Replica layout.

    Args:
        data: the folder with photos, depth images and poses.
        output: folder for all runs; this one goes to NAME/splatfacto-cpu/TIMESTAMP, see :func:`run_folder`.
        name: name of the scene.
        steps: training steps.
        timestamp: name of the run's folder.
        seed_points: number of points, taken from the depth images, that the scene starts from.
        options: further options of ``ns-train splatfacto-cpu``.
    """
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
    """The command that trains a refiner on all scenes below a folder.

    Args:
        scenes: folder that contains the trained scenes.
        output: folder for all runs; this one goes to NAME/pointsplat/TIMESTAMP, see :func:`run_folder`.
        name: name of the training.
        steps: training steps.
        timestamp: name of the run's folder.
        eval_scenes: names of scenes never to train on.
        options: further options of ``ns-train pointsplat``.
    """
    held_out = {"pipeline.datamanager.eval-scenes": eval_scenes} if eval_scenes else {}
    options = {"data": scenes, **held_out, **(options or {})}
    return shlex.join(_train_words(REFINER_METHOD, output, name, steps, timestamp, options))


def evaluate_command(run: Path, evaluation: Path, pictures: Path) -> str:
    """The command that evaluates a run on the held-out views of its scenes.

    Args:
        run: folder of the run.
        evaluation: JSON file to write.
        pictures: folder for images of all views.
    """
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
