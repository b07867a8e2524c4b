"""What further inputs could bring to the feedback network: neighbours, and members.

    python -m lab.feedback_study scenes/kettle_pod.ply scenes/pc_flowers.ply \\
        --unseen scenes/bouquet.ply --json docs/record/feedback_inputs.json

The shipped network repairs pieces of scenes, and keeps, for a share of the Gaussians in each step,
the inputs and how the PSNR at the end depends on the logarithms of the factors, to first order. A
small network learns from each of :data:`~lab.feedback_inputs.COLUMNS` to say in which direction
these factors should change. In pieces of scenes that it never saw, its changes are made as large as
:data:`CHANGE` (root mean square), and two gains are measured: to first order, and by repairing with
the changed factors. The program measures how much more there is to know in an input, without a
training that converges.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import tyro
from torch import Tensor, nn

import pointsplat_ns as ps
from lab.common.printing import console, table
from lab.common.printing import start as start_program
from lab.common.results import Row, write_json
from lab.common.scenes import name_of
from lab.feedback_inputs import COLUMNS, all_inputs
from lab.feedback_pieces import PIECES, Piece, pieces_of
from lab.feedback_training import Kept, measured_loss, reached, roll_out
from pointsplat_ns.errors import DataError
from pointsplat_ns.refinement.feedback import (
    FeedbackRefiner,
    read_feedback_refiner,
    shipped_feedback_refiner,
)
from pointsplat_ns.scene.gaussians import PARAMETERS

CHANGE = 0.25
"""Root mean square of the changes of the factors' logarithms."""

ROWS = 2_000
"""Rows of a repair that the small networks learn from."""

EPOCHS = 12
"""Passes of the small networks over all rows."""

HEADS = ("inputs", "first order, dB", "repaired, dB", "each piece, dB", "CPU ms a step")


@dataclass(frozen=True, eq=False)
class Samples:
    """What a repair tells about factors."""

    inputs: Tensor  # [M, F] of all_inputs
    gains: Tensor  # [M, 6] of the last PSNR, dB, by the factors' logarithms


def samples_of(network: FeedbackRefiner, piece: Piece, steps: int, seed: int) -> Samples:
    """Samples of a repair by a network, scaled to stand for all Gaussians."""
    kept = Kept([], [], [])
    last = roll_out(_by_own(network), piece, steps, seed, all_inputs, kept)
    views = [(index, size) for index in range(PIECES.held_out) for size in range(3)]
    slopes = kept.slopes(measured_loss(last, piece, views)[1])
    inputs = torch.cat(kept.features)
    with torch.no_grad():
        factors = _by_own(network)(inputs)
    share = len(kept.rows[0]) / len(piece.merged)
    return Samples(inputs, -slopes * factors / share)


def _by_own(network: FeedbackRefiner) -> Callable[[Tensor], Tensor]:
    return lambda inputs: network(inputs[:, : FeedbackRefiner.FEATURES])


def direction_of(samples: list[Samples], columns: list[int], seed: int) -> nn.Module:
    """A network that says from inputs (M, F) how factors' logarithms (M, 6) should change, up to
    scale: a least-squares fit of the gains, of which outliers are clamped."""
    generator = torch.Generator().manual_seed(seed)
    parts = [torch.randperm(len(s.inputs), generator=generator)[:ROWS] for s in samples]
    inputs = torch.cat([s.inputs[rows] for s, rows in zip(samples, parts, strict=True)])[:, columns]
    gains = torch.cat([s.gains[rows] for s, rows in zip(samples, parts, strict=True)])
    unit = gains.square().mean(0).sqrt() + 1e-12
    targets = (gains / unit).clamp(-5, 5)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = nn.Sequential(
            nn.Linear(len(columns), 64), nn.SiLU(), nn.Linear(64, len(PARAMETERS))
        )
    adam = torch.optim.Adam(network.parameters(), lr=3e-3, weight_decay=1e-4)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(inputs), generator=generator).split(512):
            adam.zero_grad()
            (network(inputs[rows]) - targets[rows]).square().mean().backward()
            adam.step()
    with torch.no_grad():  # in units of the gains: parameters that matter more change more
        network[-1].weight *= (unit / unit.max())[:, None]
        network[-1].bias *= unit / unit.max()
    return network.eval().requires_grad_(requires_grad=False)


def main(
    scenes: Annotated[list[Path], tyro.conf.Positional],
    unseen: tuple[Path, ...],
    start: Path | None = None,
    keep: tuple[float, ...] = (0.1, 0.3),
    pieces: int = 2,
    unseen_pieces: int = 4,
    folder: Path = Path("outputs/feedback_pieces"),
    steps: int = 48,
    seed: int = 0,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Measure what neighbours and members could bring to the feedback network.

    Args:
        scenes: 3DGS .ply files or runs to learn from.
        unseen: 3DGS .ply files or runs to compare on.
        start: the network whose factors change; by default the one that ships.
        keep: shares that pieces to learn from are merged to, in turns; others to the first.
        pieces: number of pieces of each scene to learn from.
        unseen_pieces: number of pieces of each other scene.
        folder: folder of the pieces.
        steps: number of steps of the repairs.
        seed: seed of all choices.
        json_path: write all rows there.
    """

    def made(paths: list[Path], shares: tuple[float, ...], count: int) -> list[Piece]:
        folder.mkdir(parents=True, exist_ok=True)
        found = [
            piece
            for path in paths
            for piece in pieces_of(name_of(path), ps.load(path), shares, count, folder, seed)
        ]
        if not found:
            raise DataError("no piece to measure on; expected at least one")
        return found

    known = made(scenes, keep, pieces)
    others = made([*unseen], keep[:1], unseen_pieces)
    cpu = torch.device("cpu")
    network = shipped_feedback_refiner(cpu) if start is None else read_feedback_refiner(start)
    learned = [samples_of(network, piece, steps, seed) for piece in known]
    judged = [samples_of(network, piece, steps, seed) for piece in others]
    before = [round(reached(network, piece, steps, seed), 3) for piece in others]
    rows: list[Row] = []
    for name, columns in COLUMNS.items():
        direction = direction_of(learned, columns, seed)
        found = torch.cat([direction(s.inputs[:, columns]) for s in judged])
        scale = CHANGE / float(found.square().mean().sqrt())
        first = [scale * float((direction(s.inputs[:, columns]) * s.gains).sum()) for s in judged]
        begun = time.process_time()
        changed = _changed(network, direction, columns, scale)
        after = [reached(changed, piece, steps, seed, all_inputs) for piece in others]
        spent = (time.process_time() - begun) / (steps * len(others))
        gains = {
            piece.name: round(new - old, 3)
            for piece, old, new in zip(others, before, after, strict=True)
        }
        row: Row = {"inputs": name, "first_order": round(fmean(first), 3), "gains": gains}
        rows.append(row | {"cpu_ms": round(1e3 * spent, 1)})
        console().print(table("unseen pieces", HEADS, [_line(rows[-1])]))
        about = {"steps": steps, "change": CHANGE, "known": len(known), "before": before}
        write_json(json_path, {**about, "rows": rows})
    console().print(table("unseen pieces", HEADS, map(_line, rows)))


def _changed(
    network: FeedbackRefiner, direction: nn.Module, columns: list[int], scale: float
) -> Callable[[Tensor], Tensor]:
    def factors(inputs: Tensor) -> Tensor:
        change: Tensor = scale * direction(inputs[:, columns])
        return _by_own(network)(inputs) * change.clamp(-1, 1).exp()

    return factors


def _line(row: Row) -> list[str]:
    gains = row["gains"].values()
    return [
        row["inputs"],
        f"{row['first_order']:+.2f}",
        f"{fmean(gains):+.2f}",
        " ".join(f"{gain:+.2f}" for gain in gains),
        f"{row['cpu_ms']:.1f}",
    ]


if __name__ == "__main__":
    start_program(main)
