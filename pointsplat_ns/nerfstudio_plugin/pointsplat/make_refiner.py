"""Makes a refiner from nothing: rooms, scenes trained on them, refiner training, evaluation, card.

It did not make the refiner that ships, whose card in ``pointsplat_ns/refiner/pretrained`` names its scenes.
"""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import replacing
from pointsplat_ns.io.runs import REFINER_METHOD
from pointsplat_ns.nerfstudio_plugin.commands import SCENE_METHOD, evaluate_command, run_folder
from pointsplat_ns.nerfstudio_plugin.pointsplat.recipe import (
    KEEP,
    TRAIN_SEEDS,
    UNSEEN_SEEDS,
    card_text,
    refiner_command,
    scene_settings,
)
from pointsplat_ns.nerfstudio_plugin.pointsplat.results import REFINER_NAME, VARIANTS, read_evaluation
from pointsplat_ns.nerfstudio_plugin.running import StoppedError, finished, remove_interrupted, run
from pointsplat_ns.refiner import read_refiner, save_refiner
from pointsplat_ns.rooms import write_room
from pointsplat_ns.system.packages import need

TIMESTAMP = "recipe"
"""Folder name of the runs, the same in each call, so that finished ones are found again."""


@dataclass(frozen=True)
class MadeRefiner:
    """The results of :func:`make_refiner`."""

    weights: Path
    card: Path
    """Model card: training data, command, results."""
    pictures: Path
    """Folder of images: photo, dense, pruned and refined side by side."""
    results: dict[str, Any]
    """Results of the evaluation."""


def make_refiner(
    output: str | Path,
    weights: str | Path | None = None,
    size: Literal["tiny", "small", "full"] = "tiny",
    steps: int = 700,
    rooms: int | None = None,
    workers: int | None = None,
    seed: int = 0,
) -> MadeRefiner:
    """Generate rooms, train a scene of each, train a refiner on them, and evaluate it on rooms it was not trained on.

    The commands that it runs are printed. After an interruption, a second call continues with what is not finished.

    Args:
        output: folder for all results.
        weights: folder for refiner.safetensors and CARD.md; by default the output folder.
        size: size of the network.
        steps: training steps of the network.
        rooms: number of rooms to train on; by default all.
        workers: number of scenes trained at the same time, on one thread each; by default one per core.
        seed: seed of the network's initial weights and of the order of scenes and views.

    Raises:
        DataError: if ``rooms`` or ``steps`` is out of range.
        MissingPackageError: if nerfstudio is not installed.
        SceneError: if a training of another number of steps has finished in the folder.
        PointSplatError: if a command fails.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.make_refiner("outputs/mine", steps=0)
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.DataError: --steps 0: expected at least 1
    """
    output = Path(output)
    if rooms is not None and not 1 <= rooms <= len(TRAIN_SEEDS):
        raise DataError(f"--rooms {rooms}: expected 1 to {len(TRAIN_SEEDS)}")
    if steps < 1:
        raise DataError(f"--steps {steps}: expected at least 1")
    need("nerfstudio", "training")
    train_seeds = TRAIN_SEEDS[:rooms]
    _make_scenes(output, (*train_seeds, *UNSEEN_SEEDS), workers or os.cpu_count() or 1)

    name = f"{size}-{steps}-{len(train_seeds)}rooms-seed{seed}"
    trained = run_folder(output / "refiners", name, REFINER_METHOD, TIMESTAMP)
    evaluation, pictures = output / f"{name}.json", output / "pictures" / name
    if not finished(trained, steps):
        remove_interrupted(trained)
        evaluation.unlink(missing_ok=True)
        run(refiner_command(output / "scenes", output / "refiners", name, TIMESTAMP, size, steps, seed))
    if not evaluation.is_file():
        run(evaluate_command(trained, evaluation, pictures))
    results = read_evaluation(evaluation)

    options = "" if rooms is None else f" --rooms {rooms}"
    about = {
        "command": f"pointsplat make-refiner --size {size} --steps {steps} --seed {seed}{options}",
        "by": "merge",
        "keep": KEEP,
        "steps": steps,
        "scenes": [f"room{seed}" for seed in train_seeds],
        "unseen": {variant: results["average_unseen"][variant] for variant in VARIANTS},
    }
    target = Path(weights or output)
    refiner = read_refiner(trained / REFINER_NAME)
    save_refiner(refiner, target / REFINER_NAME, about)
    command = refiner_command(Path("scenes"), Path("refiners"), name, TIMESTAMP, size, steps, seed)
    with replacing(target / "CARD.md") as part:
        parameters = sum(p.numel() for p in refiner.parameters())
        part.write_text(card_text(about, results, command, parameters), encoding="utf-8")
    return MadeRefiner(target / REFINER_NAME, target / "CARD.md", pictures, results)


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
        trained = run_folder(output / "scenes", settings.name, SCENE_METHOD, TIMESTAMP)
        if finished(trained, settings.steps):
            return
        remove_interrupted(trained)
        data = output / "rooms" / settings.name
        if not data.is_dir():
            write_room(data, seed, settings.frames, settings.width, settings.height, stop_or_go_on)
        command = settings.train_command(data, output / "scenes", TIMESTAMP)
        run(command, output / "logs" / f"{settings.name}.txt", threads=1, stop=stop)

    with ThreadPoolExecutor(workers) as pool:
        try:
            for job in as_completed([pool.submit(make, seed) for seed in seeds]):
                job.result()
        except BaseException:
            stop.set()
            pool.shutdown(cancel_futures=True)
            raise
