"""What further inputs bring to the feedback network: neighbours, and members.

    python -m lab.feedback_study scenes/kettle_pod.ply scenes/pc_flowers.ply \\
        --unseen scenes/bouquet.ply --start NET.safetensors --updates 40 --json study.json

Networks with each of :data:`~lab.feedback_inputs.INPUTS` are trained from the same network, by the
same repairs of the same pieces, and then repair pieces of scenes that no training saw. PSNR is
that of held-out views of these pieces.
"""

from __future__ import annotations

import time
from pathlib import Path
from statistics import fmean
from typing import Annotated

import tyro

import pointsplat_ns as ps
from lab.common.printing import console, table
from lab.common.printing import start as start_program
from lab.common.results import Row, write_json
from lab.common.scenes import name_of
from lab.feedback_inputs import INPUTS, Inputs, no_inputs, widened
from lab.feedback_pieces import PIECES, Piece, pieces_of
from lab.feedback_training import reached, train_feedback
from pointsplat_ns.refinement.feedback import FeedbackRefiner, read_feedback_refiner

HEADS = ("network", "steps", "PSNR, dB", "over the start", "worst piece", "CPU ms a step")


def main(
    scenes: Annotated[list[Path], tyro.conf.Positional],
    start: Path,
    unseen: tuple[Path, ...],
    keep: tuple[float, ...] = (0.1, 0.3),
    pieces: int = 2,
    unseen_pieces: int = 4,
    folder: Path = Path("outputs/feedback_pieces"),
    updates: int = 40,
    at_once: int = 2,
    steps: tuple[int, ...] = (48,),
    seed: int = 0,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Train networks with other inputs, and compare them in scenes that they never saw.

    Args:
        scenes: 3DGS .ply files or runs to train on.
        start: the network that all trainings start from.
        unseen: 3DGS .ply files or runs to compare on.
        keep: shares that pieces for training are merged to, in turns; others to the first.
        pieces: number of pieces of each scene for training.
        unseen_pieces: number of pieces of each other scene.
        folder: folder of the pieces.
        updates: number of updates of each training.
        at_once: number of repairs in an update.
        steps: numbers of steps of the repairs that are compared.
        seed: seed of all choices.
        json_path: write all rows there.
    """

    def made(paths: list[Path], shares: tuple[float, ...], count: int) -> list[Piece]:
        return [
            piece
            for path in paths
            for piece in pieces_of(name_of(path), ps.load(path), shares, count, folder, seed)
        ]

    for_training = made(scenes, keep, pieces)
    others = made([*unseen], keep[:1], unseen_pieces)
    known = read_feedback_refiner(start)
    for piece in others:  # their renders are in no one's time
        for index in range(PIECES.views):
            for size in range(3):
                piece.target(index, size)
    rows: list[Row] = []

    def compare(name: str, network: FeedbackRefiner, inputs: Inputs = no_inputs) -> None:
        for count in steps:
            begun = time.process_time()
            psnrs = {piece.name: reached(network, piece, count, seed, inputs) for piece in others}
            spent = (time.process_time() - begun) / (count * len(others))
            rows.append(
                {"network": name, "steps": count, "psnrs": psnrs, "milliseconds": 1e3 * spent}
            )
            console().print(table("unseen pieces", HEADS, [_line(rows, rows[-1])]))
            write_json(json_path, {"updates": updates, "at_once": at_once, "rows": rows})

    compare("start", known)
    compare("Adam", FeedbackRefiner())
    for name, (inputs, more) in INPUTS.items():
        network = widened(known, more)
        train_feedback(
            for_training, updates, at_once, seed, start=known, network=network, inputs=inputs
        )
        compare(name, network, inputs)
    console().print(table("unseen pieces", HEADS, [_line(rows, row) for row in rows]))


def _line(rows: list[Row], row: Row) -> list[str]:
    first = next(other for other in rows if other["steps"] == row["steps"])["psnrs"]
    leads = {name: row["psnrs"][name] - first[name] for name in first}
    worst = min(leads, key=lambda name: leads[name])
    return [
        row["network"],
        str(row["steps"]),
        f"{fmean(row['psnrs'].values()):.2f}",
        f"{fmean(leads.values()):+.2f}",
        f"{leads[worst]:+.2f} ({worst})",
        f"{row['milliseconds']:.1f}",
    ]


if __name__ == "__main__":
    start_program(main)
