"""Trains the network that sets the steps of repairs.

python -m lab.make_feedback kitchen.ply room.ply -o feedback.safetensors --updates 200
"""

from __future__ import annotations

import functools
import math
from pathlib import Path
from typing import Annotated

import torch
import tyro

import pointsplat_ns as ps
from lab.common.printing import start as start_program
from lab.feedback_training import TrainingScene, train_feedback
from pointsplat_ns.refinement.feedback import read_feedback_refiner
from pointsplat_ns.system.processes import connect_torchrun, local_rank, torchrun_rank
from pointsplat_ns.system.progress import progress_bar, tracked
from pointsplat_ns.system.threads import fixed_threads


def main(
    scenes: Annotated[list[Path], tyro.conf.Positional],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs/feedback.safetensors"),
    keep: tuple[str, ...] = ("3%", "10%", "30%", "50%"),
    updates: int = 1000,
    seconds: float | None = None,
    at_once: int = 4,
    seed: int = 0,
    start: Path | None = None,
    threads: int | None = None,
) -> None:
    """Train the network that sets the steps of `compact`'s repairs, on scenes and what is merged of
    them; no photos.

    It is saved every minute and at the end. With a GPU, 1,000 updates take some minutes to an hour;
    without one, days. Under `torchrun --nproc-per-node 4 -m lab.make_feedback ...` four processes
    share the work; on one GPU that pays too.

    Args:
        scenes: 3DGS .ply files, Splatfacto checkpoints or runs.
        output: file for the network.
        keep: budgets that the scenes are merged to: ratios (0.3), percentages (30%) or counts
            (50000).
        updates: number of updates of the network, at most.
        seconds: time limit, by default none; the learning rate then falls with the time.
        at_once: number of repairs in an update.
        seed: seed of the initial weights and of all choices.
        start: continue from this network with a third of the learning rate; by default from a
            network with plain Adam.
        threads: number of threads. By default it adapts to the work and to other programs. Another
            number may change results by rounding.
    """
    if seconds is not None and not seconds > 0:
        raise ps.DataError(f"--seconds {seconds:g}: expected a number above 0")
    if updates < 1:
        raise ps.DataError(f"--updates {updates}: expected at least 1")
    known = None if start is None else read_feedback_refiner(start)
    connect_torchrun()
    count = torch.cuda.device_count()
    first = torchrun_rank()[0] == 0
    ready = []
    device = torch.device("cuda", local_rank() % count) if count else torch.device("cpu")
    with fixed_threads(threads):
        for path in tracked(scenes, "merging scenes", len(scenes), first):
            ready.append(TrainingScene.of(path.stem, ps.load(path).to(device), keep))
            if first:
                print(
                    f"{path}: {len(ready[-1].dense):,} Gaussians, {len(ready[-1].views[0])} views"
                )
        with progress_bar(first) as show:
            report = functools.partial(show, "training")
            train_feedback(
                ready, updates, at_once, seed, output, report, seconds or math.inf, known
            )
    if first:
        print(f"{output}: the network")


if __name__ == "__main__":
    start_program(main)
