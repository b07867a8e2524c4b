"""The ``ns-*`` command lines of trainings and evaluations, as a person would type them. nerfstudio is not imported."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SCENE_METHOD, REFINER_METHOD = "splatfacto-cpu", "pointsplat"

Options = Mapping[str, Any]
"""Values by the name of an option without its dashes; a tuple or list is several words."""


def train_scene_command(
    data: Path, output: Path, name: str, steps: int, timestamp: str, seed_points: int, options: Options | None = None
) -> str:
    """Trains a Splatfacto scene of a folder in the Replica layout.

    Args:
        data: the folder with photos, depth images and poses.
        output: folder for all runs; this one is in NAME/splatfacto-cpu/TIMESTAMP, see :func:`run_folder`.
        name: of the scene.
        steps: of the training.
        timestamp: names the run.
        seed_points: the scene starts from so many points of the depth images.
        options: further ones of ``ns-train splatfacto-cpu``.
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
    """Trains a refiner on all scenes below a folder.

    Args:
        scenes: folder above the trained scenes.
        output: folder for all runs; this one is in NAME/pointsplat/TIMESTAMP, see :func:`run_folder`.
        name: of the training.
        steps: of the training.
        timestamp: names the run.
        eval_scenes: names of scenes never to train on.
        options: further ones of ``ns-train pointsplat``.
    """
    held_out = {"pipeline.datamanager.eval-scenes": eval_scenes} if eval_scenes else {}
    options = {"data": scenes, **held_out, **(options or {})}
    return shlex.join(_train_words(REFINER_METHOD, output, name, steps, timestamp, options))


def evaluate_command(run: Path, evaluation: Path, pictures: Path) -> str:
    """Judges a run in the held-out views of its scenes.

    Args:
        run: its folder.
        evaluation: the JSON file to write.
        pictures: folder for pictures of all views.
    """
    words = ["ns-eval", "--load-config", str(run / "config.yml"), "--output-path", str(evaluation)]
    return shlex.join([*words, "--render-output-path", str(pictures)])


def run_folder(output: Path, name: str, method: str, timestamp: str) -> Path:
    """Where nerfstudio puts a run."""
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
