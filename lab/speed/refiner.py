"""Time, memory and work of the refiner against the number of Gaussians.

    python -m lab.speed.refiner                                  # all sizes; about three minutes
    python -m lab.speed.refiner --sizes small --counts 59000

Inference is ``refiner(scene, structure)`` without gradients; a training step is forward and backward of a sum over the
refined parameters; the structure (serialization and neighbour tables) is made once per scene and timed apart. GFLOP
count a multiply-add of matrix products and attention as two.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch.utils.flop_counter import FlopCounterMode

from lab.common.printing import console, megabytes, number, start, table
from lab.common.results import write_json
from lab.common.scenes import room
from lab.common.timing import peak_extra_bytes, seconds_of, slope, timed
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.refiner import PRESETS, Refiner, preset

COUNTS = {"tiny": (1_000, 10_000, 59_000, 300_000), "small": (1_000, 10_000, 59_000, 300_000), "full": (1_000, 10_000)}
"""Counts of a default run: fewer of the published size, of which one inference takes a minute at 30,000."""

TRAINED_UP_TO = {"tiny": 100_000, "small": 59_000, "full": 1_000}
"""Most Gaussians of a training step."""

REPEATS, BUDGET = 3, 4.0
"""Rounds at most, and seconds after which a figure is content with the rounds that it has."""


@dataclass(frozen=True)
class Result:
    """One size at one count. Seconds, bytes, floating-point operations."""

    size: str
    gaussians: int
    structure: float
    inference: float
    inference_bytes: int | None
    flops: int
    step: float | None
    step_bytes: int | None


def run_case(size: str, count: int, device: torch.device) -> Result:
    """Everything that is measured of one size at one count."""
    torch.manual_seed(0)
    scene, refiner = room(count).to(device), Refiner(preset(size)).to(device)
    structure = refiner.prepare(scene)

    @torch.no_grad()
    def infer() -> None:
        refiner(scene, structure)

    def step() -> None:
        refiner.zero_grad(set_to_none=True)
        sum(value.sum() for value in refiner(scene, structure).tensors()).backward()

    def seconds(call: Callable[[], object]) -> float:
        return timed({"": lambda: {"": seconds_of(call)}}, REPEATS, BUDGET)[""]

    trained = count <= TRAINED_UP_TO[size]
    with FlopCounterMode(display=False) as counter:
        infer()
    return Result(
        size, count, seconds(lambda: refiner.prepare(scene)), seconds(infer), peak_extra_bytes(infer, device),
        counter.get_total_flops(), seconds(step) if trained else None,
        peak_extra_bytes(step, device) if trained else None,
    )  # fmt: skip


def print_tables(results: list[Result]) -> None:
    """Figures by case, then the slopes by size."""
    heads = ("size", "Gaussians", "structure, s", "inference, s", "MB", "GFLOP", "training step, s", "step, MB")
    rows = [
        [r.size, f"{r.gaussians:,}", *map(number(3), (r.structure, r.inference)), megabytes(r.inference_bytes),
         number(1, 1e-9)(r.flops), number(3)(r.step), megabytes(r.step_bytes)]
        for r in results
    ]  # fmt: skip
    console().print(table("Refiner: time, peak memory and work", heads, rows))
    lines = []
    for size in dict.fromkeys(r.size for r in results):
        same = [r for r in results if r.size == size]
        kinds = ([getattr(r, name) for r in same] for name in ("structure", "inference", "step"))
        lines.append([size, *(number(2)(slope([r.gaussians for r in same], values)) for values in kinds)])
    heads = ("size", "structure", "inference", "training step")
    console().print(table("Slopes of log time over log Gaussians (1: linear)", heads, lines))


def main(
    sizes: tuple[str, ...] = tuple(PRESETS),
    counts: tuple[int, ...] = (),
    threads: int | None = None,
    device: str = "cpu",
    json: Path | None = None,
) -> None:
    """Time the refiner by size and number of Gaussians.

    Args:
        sizes: of the network: tiny, small, full.
        counts: numbers of Gaussians, for every size; by default a choice for each.
        threads: of torch; its own choice by default.
        device: where it runs.
        json: write all figures here, after each case.
    """
    unknown = [size for size in sizes if size not in PRESETS]
    if unknown or not sizes:
        raise PointSplatError(f"no refiner size {', '.join(unknown)!r}; expected some of {', '.join(PRESETS)}")
    if counts and min(counts) < 1:
        raise PointSplatError(f"counts are {counts}; expected numbers of Gaussians from 1 on")
    if threads:
        torch.set_num_threads(threads)
    print(f"torch {torch.__version__} on {device}, {torch.get_num_threads()} threads")
    results: list[Result] = []
    for size in sizes:
        for count in counts or COUNTS[size]:
            results.append(run_case(size, count, torch.device(device)))
            print(f"{size}, {count:,} Gaussians: {results[-1].inference:.3f} s", flush=True)
            write_json(json, {"torch": torch.__version__, "cases": [asdict(r) for r in results]})
    print_tables(results)


if __name__ == "__main__":
    start(main)
