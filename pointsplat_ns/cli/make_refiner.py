"""``pointsplat make-refiner``: the refiner that ships, from nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro


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
    import pointsplat_ns as ps
    from pointsplat_ns.nerfstudio_plugin.pointsplat.report import show_report

    made = ps.make_refiner(output, weights, size, steps, rooms, workers, seed)
    show_report(made.results)
    print(f"{made.weights}: the refiner, {made.weights.stat().st_size / 1e6:.1f} MB")
    print(f"{made.card}: what it was made of, and what it does")
    print(f"{made.pictures}: photo, dense, pruned and refined side by side")
