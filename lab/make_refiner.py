"""Makes a refiner from nothing: rooms, scenes trained on them, refiner training, evaluation.

It did not make the refiner that ships, whose card in ``pointsplat_ns/refiner/pretrained`` names its scenes. The scenes
that it makes also serve ``python -m lab.tables.networks``.
"""

from __future__ import annotations

import math
import os
import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

from lab.common.printing import start
from lab.common.running import (
    StoppedError,
    evaluate_command,
    folder_of_run,
    has_finished,
    remove_interrupted,
    run,
    train_refiner_command,
    train_scene_command,
)
from lab.rooms import write_room
from pointsplat_ns.errors import DataError
from pointsplat_ns.io.runs import METHOD_NAMES, RUN_FILES


@dataclass(frozen=True)
class RecipeSettings:
    """Choices of the recipe that have no option."""

    timestamp: str = "recipe"
    """Folder name of the runs, the same in each call, so that finished ones are found again."""
    train_seeds: tuple[int, ...] = tuple(range(100, 116))
    """Seeds of the rooms that the refiner is trained on."""
    unseen_seeds: tuple[int, ...] = (50, 51, 52, 53)
    """Seeds of the rooms that the refiner is evaluated on."""
    keep: float = 0.1
    """Share of the Gaussians that scenes are merged to in training."""


RECIPE = RecipeSettings()


def main(
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs/make-refiner"),
    size: Literal["tiny", "small", "full"] = "tiny",
    steps: int = 700,
    rooms: int | None = None,
    workers: int | None = None,
    seed: int = 0,
) -> None:
    """Generate rooms, train a scene of each, train a refiner on them, and evaluate it on rooms it was not trained on.

    The commands that it runs are printed. After an interruption, a second call continues with what is not finished.

    Args:
        output: folder for all results.
        size: size of the network.
        steps: training steps of the network.
        rooms: number of rooms to train on; by default all.
        workers: number of scenes trained at the same time, on one thread each; by default one per core.
        seed: seed of the network's initial weights and of the order of scenes and views.
    """
    if rooms is not None and not 1 <= rooms <= len(RECIPE.train_seeds):
        raise DataError(f"--rooms {rooms}: expected 1 to {len(RECIPE.train_seeds)}")
    if steps < 1:
        raise DataError(f"--steps {steps}: expected at least 1")
    train_seeds = RECIPE.train_seeds[:rooms]
    _make_scenes(output, (*train_seeds, *RECIPE.unseen_seeds), workers or os.cpu_count() or 1)

    name = f"{size}-{steps}-{len(train_seeds)}rooms-seed{seed}"
    trained = folder_of_run(output / "refiners", name, METHOD_NAMES.refiner, RECIPE.timestamp)
    evaluation, pictures = output / f"{name}.json", output / "pictures" / name
    if not has_finished(trained, steps):
        remove_interrupted(trained)
        run(refiner_command(output / "scenes", output / "refiners", name, RECIPE.timestamp, size, steps, seed))
    run(evaluate_command(trained, evaluation, pictures))
    print(f"{trained / RUN_FILES.refiner}: the refiner")
    print(f"{evaluation}, {pictures}: PSNR, SSIM, LPIPS; photo, dense, pruned and refined side by side")


def _make_scenes(output: Path, seeds: tuple[int, ...], workers: int) -> None:
    """Generate the rooms and train a scene of each, ``workers`` at a time with one thread each.

    Ctrl-C or an error in one of them stops them all.
    """
    stop = threading.Event()

    def stop_or_go_on(what: str, share: float) -> None:
        if stop.is_set():
            raise StoppedError(what)

    def make(seed: int) -> None:
        settings = scene_settings(seed)
        trained = folder_of_run(output / "scenes", settings.name, METHOD_NAMES.scene, RECIPE.timestamp)
        if has_finished(trained, settings.steps):
            return
        remove_interrupted(trained)
        data = output / "rooms" / settings.name
        if not data.is_dir():
            write_room(data, seed, settings.frames, settings.width, settings.height, stop_or_go_on)
        command = settings.train_command(data, output / "scenes", RECIPE.timestamp)
        run(command, output / "logs" / f"{settings.name}.txt", threads=1, stop=stop)

    with ThreadPoolExecutor(workers) as pool:
        try:
            for job in as_completed([pool.submit(make, seed) for seed in seeds]):
                job.result()
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise


@dataclass(frozen=True)
class SceneSettings:
    """How the room of a seed is captured, and how a Splatfacto scene is trained on it."""

    seed: int
    frames: int
    width: int
    height: int
    steps: int
    seed_points: int
    densify_grad_thresh: float
    cull_alpha_thresh: float
    antialiased: bool
    scale_regularization: bool

    @property
    def name(self) -> str:
        return f"room{self.seed}"

    def train_command(self, data: Path, output: Path, timestamp: str) -> str:
        """The ``ns-train`` command that trains the scene."""
        options = {
            "pipeline.model.densify-grad-thresh": f"{self.densify_grad_thresh:.2g}",
            "pipeline.model.cull-alpha-thresh": self.cull_alpha_thresh,
            "pipeline.model.rasterize-mode": "antialiased" if self.antialiased else "classic",
            "pipeline.model.use-scale-regularization": self.scale_regularization,
        }
        return train_scene_command(data, output, self.name, self.steps, timestamp, self.seed_points, options)


def scene_settings(seed: int) -> SceneSettings:
    """The settings drawn for a room's seed; the same seed gives the same settings."""
    rng = np.random.default_rng([seed, 22])

    def log_uniform(low: float, high: float) -> float:
        return float(math.exp(rng.uniform(math.log(low), math.log(high))))

    width, height = ((256, 192), (240, 180), (256, 160), (208, 208))[rng.integers(4)]
    return SceneSettings(
        seed=seed,
        frames=int(rng.integers(45, 81)),
        width=width,
        height=height,
        steps=round(log_uniform(400, 1100)),
        seed_points=round(log_uniform(5_000, 40_000)),
        densify_grad_thresh=log_uniform(8e-4, 2.5e-3),
        cull_alpha_thresh=float(rng.choice((0.1, 0.05, 0.02))),
        antialiased=bool(rng.random() < 0.2),
        scale_regularization=bool(rng.random() < 0.3),
    )


def refiner_command(scenes: Path, output: Path, name: str, timestamp: str, size: str, steps: int, seed: int) -> str:
    """The ``ns-train`` command that trains the refiner."""
    options = {
        "pipeline.datamanager.supervision": "dense",
        "pipeline.datamanager.seed": seed,
        "pipeline.model.size": size,
        "pipeline.model.keep": RECIPE.keep,
        "pipeline.model.pixel-loss": "rmse",
        "pipeline.model.lpips-weight": 0.05,
        "rate-factor": 8,
    }
    unseen = tuple(f"room{seed}" for seed in RECIPE.unseen_seeds)
    return train_refiner_command(scenes, output, name, steps, timestamp, unseen, options)


if __name__ == "__main__":
    start(main)
