"""``pointsplat make-refiner``: makes a refiner from nothing, on built-in rooms."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from pointsplat_ns.cli.printing import written_size
from pointsplat_ns.cli.scene_options import claim_folder


def make_refiner(
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs/make-refiner"),
    weights: Path | None = None,
    size: Literal["tiny", "small", "full"] = "tiny",
    steps: int = 700,
    rooms: int | None = None,
    workers: int | None = None,
    seed: int = 0,
) -> None:
    """Train a refiner from scratch: generate rooms, train a scene of each, train the network, evaluate on unseen rooms.

    `pointsplat compact --refiner` takes the result. It needs no data, no photos and no GPU. After an interruption, a
    second call continues with what is not finished.

    Args:
        output: folder for all results.
        weights: folder for refiner.safetensors and CARD.md; by default the output folder.
        size: size of the network.
        steps: training steps of the network.
        rooms: number of rooms to train on; by default all.
        workers: number of scenes trained at the same time, on one thread each; by default one per core.
        seed: seed of the network's initial weights and of the order of scenes and views.
    """
    import pointsplat_ns as ps
    from pointsplat_ns.nerfstudio_plugin.pointsplat.report import show_report

    for folder in dict.fromkeys((output, weights or output)):
        claim_folder(folder)
    result = ps.make_refiner(output, weights, size, steps, rooms, workers, seed)
    show_report(result.results)
    print(f"{result.weights}: the refiner, {written_size(result.weights)}")
    print(f"{result.card}: its training and results")
    print(f"{result.pictures}: photo, dense, pruned and refined side by side")
