"""Trains the network that sets the steps of repairs.

python -m lab.make_feedback kitchen.ply room.ply -o feedback.safetensors --updates 200
"""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Annotated

import torch
import tyro

import pointsplat_ns as ps
from lab.common.printing import start as start_program
from lab.common.scenes import name_of
from lab.feedback_pieces import Piece, pieces_of
from lab.feedback_training import train_feedback
from pointsplat_ns.refinement.feedback import (
    FeedbackRefiner,
    read_feedback_refiner,
    shipped_feedback_refiner,
)
from pointsplat_ns.system.processes import by_first, connect_torchrun, local_rank, torchrun_rank
from pointsplat_ns.system.progress import progress_bar, tracked
from pointsplat_ns.system.threads import fixed_threads

LOGGED = 10
"""Updates whose mean gain is printed together."""


def main(
    scenes: Annotated[list[Path], tyro.conf.Positional],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("outputs/feedback.safetensors"),
    keep: tuple[float, ...] = (0.1, 0.3),
    pieces: int = 8,
    pieces_folder: Path | None = None,
    updates: int = 1000,
    at_once: int = 4,
    seed: int = 0,
    start: Path | None = None,
    threads: int | None = None,
) -> None:
    """Train the network that sets the steps of `compact`'s repairs, on pieces of scenes and what is
    merged of them; no photos.

    The pieces are made first, and kept as files. The network is saved every minute and at the end,
    with the state of its training beside it: the same command resumes from that, and ends with the
    same bits. On a CPU, a piece takes a second or two, and an update of four repairs three. With a
    GPU, the repairs run there. Under `torchrun --nproc-per-node 4 -m lab.make_feedback ...` four
    processes share the repairs; on one GPU that pays too.

    Args:
        scenes: 3DGS .ply files, Splatfacto checkpoints or runs.
        output: file for the network.
        keep: shares that pieces are merged to, in turns.
        pieces: number of pieces of each scene, evenly spread over it.
        pieces_folder: folder of the pieces, by default beside the network.
        updates: number of updates of the network.
        at_once: number of repairs in an update.
        seed: seed of the initial weights and of all choices.
        start: continue from this network with a smaller learning rate; "shipped" for the one that
            ships; by default from a network with plain Adam.
        threads: number of threads. By default it adapts to the work and to other programs. Another
            number may change results by rounding.
    """
    for option, value in (("--pieces", pieces), ("--updates", updates), ("--at-once", at_once)):
        if value < 1:
            raise ps.DataError(f"{option} {value}: expected at least 1")
    if not keep or not all(0 < share < 1 for share in keep):
        raise ps.DataError(f"--keep {' '.join(map(str, keep))}: expected shares between 0 and 1")
    known = None if start is None else _network(start)
    folder = pieces_folder or output.with_name(f"{output.stem}_pieces")
    connect_torchrun()
    count = torch.cuda.device_count()
    first = torchrun_rank()[0] == 0
    device = torch.device("cuda", local_rank() % count) if count else torch.device("cpu")

    def made() -> list[Piece]:
        folder.mkdir(parents=True, exist_ok=True)
        found: list[Piece] = []
        for path in tracked(scenes, "cutting scenes", len(scenes), first):
            found += pieces_of(name_of(path), ps.load(path), keep, pieces, folder, seed)
        return found

    with fixed_threads(threads):
        by_first(made)
        ready = [piece.to(device) for piece in made()]
        if first:
            print(f"{folder}: {len(ready)} pieces of {len(scenes)} scenes")
        gains: list[float] = []

        def log(update: int, gain: float) -> None:
            gains.append(gain)
            if first and (update % LOGGED == 0 or update == updates):
                recent = gains[-LOGGED:]
                print(f"update {update}: gain {sum(recent) / len(recent):.2f} dB", flush=True)

        with progress_bar(first) as show:
            report = functools.partial(show, "training")
            train_feedback(ready, updates, at_once, seed, output, report, start=known, log=log)
    if first:
        print(f"{output}: the network")


def _network(start: Path) -> FeedbackRefiner:
    if str(start) == "shipped":
        return shipped_feedback_refiner(torch.device("cpu"))
    return read_feedback_refiner(start)


if __name__ == "__main__":
    start_program(main)
