"""``pointsplat make-refiner``: the refiner that ships, from nothing."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

import tyro

TIMESTAMP = "recipe"
"""Names the runs, so that what is finished is found again."""


def make_refiner(
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs/make-refiner"),
    weights: Path | None = None,
    size: Literal["tiny", "small", "full"] = "tiny",
    steps: int = 700,
    rooms: int | None = None,
    workers: int | None = None,
    seed: int = 0,
) -> None:
    """Train a refiner from nothing: make rooms, train a scene of each, learn to repair them, judge it on unseen rooms.

    This is how the refiner that `pointsplat compact` uses was made. No data, no photos and no GPU are needed; two idle
    cores take less than an hour. What an interrupted command has finished is not done again.

    Args:
        output: folder for everything that is made.
        weights: folder for refiner.safetensors and CARD.md; by default the output folder.
        size: of the network.
        steps: of its training.
        rooms: train on the first so many rooms only; by default on all.
        workers: scenes trained side by side, on one thread each; by default as many as there are cores.
        seed: of the network's initial weights and of the order of scenes and views.
    """
    from pointsplat_ns.cli.report import read_evaluation, show_report
    from pointsplat_ns.cli.running import finished, run
    from pointsplat_ns.errors import DataError
    from pointsplat_ns.io.files import replacing
    from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import REFINER_NAME
    from pointsplat_ns.nerfstudio_plugin.pointsplat.recipe import (
        KEEP,
        TRAIN_SEEDS,
        UNSEEN_SEEDS,
        card_text,
        refiner_command,
    )
    from pointsplat_ns.refiner import read_refiner, save_refiner

    if rooms is not None and not 1 <= rooms <= len(TRAIN_SEEDS):
        raise DataError(f"--rooms {rooms}: expected 1 to {len(TRAIN_SEEDS)}")
    if steps < 1:
        raise DataError(f"--steps {steps}: expected at least 1")
    seeds = (*TRAIN_SEEDS[:rooms], *UNSEEN_SEEDS)
    make_scenes(output, seeds, workers or os.cpu_count() or 1)

    name = f"{size}-{steps}-{len(seeds) - len(UNSEEN_SEEDS)}rooms-seed{seed}"
    trained = output / "refiners" / name / "pointsplat" / TIMESTAMP
    evaluation, pictures = output / f"{name}.json", output / "pictures" / name
    if not finished(trained, steps):
        evaluation.unlink(missing_ok=True)
        run(refiner_command(output / "scenes", output / "refiners", name, TIMESTAMP, size, steps, seed))
    if not evaluation.is_file():
        config = quote(str(trained / "config.yml"))
        written = f"--output-path {quote(str(evaluation))} --render-output-path {quote(str(pictures))}"
        run(f"ns-eval --load-config {config} {written}")
    results = read_evaluation(evaluation)
    show_report(results)

    target = weights or output
    options = "" if rooms is None else f" --rooms {rooms}"
    made_by = f"pointsplat make-refiner --size {size} --steps {steps} --seed {seed}{options}"
    about = {"command": made_by, "by": "merge", "keep": KEEP, "steps": steps}
    about["scenes"] = [f"room{s}" for s in seeds[: -len(UNSEEN_SEEDS)]]
    about["unseen"] = {variant: results["average_unseen"][variant] for variant in ("dense", "pruned", "refined")}
    refiner = read_refiner(trained / REFINER_NAME)
    save_refiner(refiner, target / REFINER_NAME, about)
    command = refiner_command(Path("scenes"), Path("refiners"), name, TIMESTAMP, size, steps, seed)
    card = card_text(about, results, command, sum(p.numel() for p in refiner.parameters()))
    with replacing(target / "CARD.md") as part:
        part.write_text(card, encoding="utf-8")
    print(f"{target / REFINER_NAME}: the refiner, {(target / REFINER_NAME).stat().st_size / 1e6:.1f} MB")
    print(f"{target / 'CARD.md'}: what it was made of, and what it does")
    print(f"{pictures}: photo, dense, pruned and refined side by side")


def make_scenes(output: Path, seeds: tuple[int, ...], workers: int) -> None:
    """Rooms with photos, and a trained scene of each, ``workers`` at a time with one thread each."""
    from pointsplat_ns.cli.running import finished, run
    from pointsplat_ns.nerfstudio_plugin.pointsplat.recipe import scene_settings
    from pointsplat_ns.rooms import write_room

    def make(seed: int) -> None:
        settings = scene_settings(seed)
        trained = output / "scenes" / settings.name / "splatfacto-cpu" / TIMESTAMP
        if finished(trained, settings.steps):
            return
        data = output / "rooms" / settings.name
        if not data.is_dir():
            write_room(data, seed, settings.frames, settings.width, settings.height, False, settings.style)
        command = settings.train_command(data, output / "scenes", TIMESTAMP)
        run(command, output / "logs" / f"{settings.name}.txt", threads=1)

    with ThreadPoolExecutor(workers) as pool:
        jobs = [pool.submit(make, seed) for seed in seeds]
        try:
            for job in jobs:
                job.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
