"""Where a step of a ``splatfacto-cpu`` training goes, and what its parts save beside those that nerfstudio configures.

    python benchmarks/training.py outputs/kitchen/splatfacto-cpu/RUN --downscale 1 2

Steps go on from the end of a finished training whose photos are at hand, at its number of Gaussians. They alternate
between ours, ours without compiled kernels, and one with nerfstudio's Adam and pytorch-msssim's SSIM besides, so that a
busy moment hits all. CPU seconds of one thread are counted, and nothing is saved.
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch
import tyro
from pytorch_msssim import SSIM
from torch.profiler import ProfilerActivity, profile

import pointsplat_ns as ps
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.io import open_run
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import dataparser_of
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

PARTS = {
    "blending": ("Blend",),
    "blending, backward": ("BlendBackward",),
    "projection": ("CompiledProject", "Project"),
    "projection, backward": ("CompiledProjectBackward", "ProjectBackward"),
    "colours by SH, both ways": ("CompiledColor", "CompiledColorBackward", "Color", "ColorBackward"),
    "Adam": ("Optimizer.step#Adam.step",),
}
"""Events of torch's profiler that are a part of a step."""

KINDS = {
    "ours": "ours",
    "torch": "drawn by torch, without a compiler",
    "theirs": "with nerfstudio's Adam and SSIM as well",
}

WARM_UP = 2
"""Steps that are not counted."""


def steps(run: tyro.conf.Positional[Path], downscale: tuple[int, ...] = (1,), count: int = 6) -> None:
    """Print a table for each size of the photos.

    Args:
        run: a finished training of ``splatfacto-cpu``.
        downscale: photos are drawn at so many times fewer pixels a side.
        count: number of steps counted of each kind.
    """
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        trainer = _trainer(run, Path(folder))
        for factor in downscale:
            trainer.pipeline.model._get_downscale_factor = lambda factor=factor: factor
            _table(trainer, count)


def _trainer(run: Path, folder: Path) -> Any:
    """nerfstudio's trainer of the run's data, with its Gaussians, all SH bands and no densification."""
    config = splatfacto_cpu_config()
    config.machine.device_type, config.output_dir, config.vis = "cpu", folder, "tensorboard"
    config.early_look = False  # type: ignore[attr-defined]
    config.pipeline.datamanager.dataparser = dataparser_of(open_run(run)).config  # type: ignore[attr-defined]
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    model = trainer.pipeline.model
    for name, value in ps.load(run).items():
        model.gauss_params[name] = torch.nn.Parameter(value)
    model._adopt_optimizers(trainer.optimizers)
    model.optimizers, model.step = trainer.optimizers.optimizers, config.max_num_iterations
    model.train()
    return trainer


def _table(trainer: Any, count: int) -> None:
    model, ours = trainer.pipeline.model, trainer.pipeline.model.ssim
    theirs = SSIM(data_range=1.0, size_average=True, channel=3).forward  # a module would be a part of the model
    step, seconds = trainer.config.max_num_iterations, {kind: [] for kind in KINDS}  # type: ignore[var-annotated]

    def take(kind: str) -> float:
        nonlocal step
        model.ssim, model.config.compiled = theirs if kind == "theirs" else ours, None if kind == "ours" else False
        for optimizer in trainer.optimizers.optimizers.values():
            for group in optimizer.param_groups:
                group["fused"] = kind != "theirs"
        start = time.process_time()
        trainer.train_iteration(step)
        step += 1
        return time.process_time() - start

    for number in range(WARM_UP + count):
        for kind, taken in seconds.items():
            spent = take(kind)
            if number >= WARM_UP:
                taken.append(spent)
    with profile(activities=[ProfilerActivity.CPU]) as found:
        start = time.perf_counter()  # the profiler's clock
        for _ in range(count):
            take("ours")
        total = time.perf_counter() - start
    spent_in = {event.key: event.cpu_time_total / 1e6 for event in found.key_averages()}
    height, width = model.last_size
    ours_takes = median(seconds["ours"])
    print(f"{width} x {height}, {len(model.means):,} Gaussians, CPU seconds a step:")
    for kind, text in KINDS.items():
        print(f"| {text} | {median(seconds[kind]):.3f} | {median(seconds[kind]) / ours_takes:.2f} |")
    known = 0.0
    for part, events in PARTS.items():
        share = sum(spent_in.get(event, 0.0) for event in events) / total
        known += share
        print(f"| {part} | {100 * share:.0f} % |")
    print(f"| the rest | {100 * (1 - known):.0f} % |", flush=True)


def main() -> None:
    """Run; input that cannot be used ends it with one line."""
    try:
        tyro.cli(steps)
    except PointSplatError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
