"""Where a step of a training goes, and what its parts save beside those that nerfstudio configures.

    python -m lab.speed.training outputs/kitchen/splatfacto-cpu/RUN --downscale 1 2
    python -m lab.speed.training outputs/kitchen/splatfacto-cpu/RUN --refiner

Steps of ``splatfacto-cpu`` go on from the end of a finished training whose photos are at hand, at its number of
Gaussians. They alternate between ours, ours without compiled kernels, and one with nerfstudio's Adam and
pytorch-msssim's SSIM besides, so that a busy moment hits all. Those of a refiner begin with a new network on that
scene, and alternate between ours and ours without compiled kernels. CPU seconds of one thread are counted, and nothing
is saved.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import torch
import tyro
from pytorch_msssim import SSIM
from torch.profiler import ProfilerActivity, profile

import pointsplat_ns as ps
from lab.common.printing import start
from pointsplat_ns.io import open_run
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import dataparser_of
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

DRAWING = {
    "blending": ("Blend",),
    "blending, backward": ("BlendBackward",),
    "projection": ("CompiledProject", "Project"),
    "projection, backward": ("CompiledProjectBackward", "ProjectBackward"),
    "colours by SH, both ways": ("CompiledColor", "CompiledColorBackward", "Color", "ColorBackward"),
    "SSIM, both ways": ("CompiledSimilarity", "CompiledSimilarityBackward"),
}
"""Events of torch's profiler that are a part of a step."""

NETWORK = {
    "linear layers, both ways": ("aten::linear", "AddmmBackward0"),
    "attention, both ways": ("aten::scaled_dot_product_attention", "ScaledDotProductFlashAttentionForCpuBackward0"),
    "sparse convolutions, both ways": ("_SubmanifoldConv", "_SubmanifoldConvBackward"),
}
"""And those of a refiner."""

ADAM = {"Adam": ("Optimizer.step#Adam.step",)}

KINDS = {
    "ours": "ours",
    "torch": "drawn by torch, without kernels",
    "theirs": "with nerfstudio's Adam and SSIM as well",
}

WARM_UP = 2
"""Steps that are not counted."""


def _trainer(run: Path, folder: Path) -> Any:
    """nerfstudio's trainer of the run's data, with its Gaussians, all SH bands and no densification."""
    config = splatfacto_cpu_config()
    config.early_look = False  # type: ignore[attr-defined]
    config.pipeline.datamanager.dataparser = dataparser_of(open_run(run)).config  # type: ignore[attr-defined]
    trainer = _started(config, None, folder)
    model = trainer.pipeline.model
    for name, value in ps.load(run).items():
        model.gauss_params[name] = torch.nn.Parameter(value)
    model._adopt_optimizers(trainer.optimizers)
    model.optimizers, model.step = trainer.optimizers.optimizers, config.max_num_iterations
    model.train()
    return trainer


def _started(config: Any, data: Path | None, folder: Path) -> Any:
    """nerfstudio's trainer of a config before its first step, on a CPU."""
    config.machine.device_type, config.output_dir, config.vis = "cpu", folder, "tensorboard"
    config.data = config.pipeline.datamanager.data = data
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def _table(trainer: Any, count: int) -> None:
    model, ours = trainer.pipeline.model, trainer.pipeline.model.ssim
    theirs = SSIM(data_range=1.0, size_average=True, channel=3).forward  # a module would be a part of the model

    def prepare(kind: str) -> None:
        model.ssim, model.config.compiled = theirs if kind == "theirs" else ours, None if kind == "ours" else False
        for optimizer in trainer.optimizers.optimizers.values():
            for group in optimizer.param_groups:
                group["fused"] = kind != "theirs"

    lines = _measured(trainer, prepare, tuple(KINDS), trainer.config.max_num_iterations, count, DRAWING | ADAM)
    height, width = model.last_size
    print(f"{width} x {height}, {len(model.means):,} Gaussians, CPU seconds a step:", *lines, sep="\n", flush=True)


def _refiners_table(trainer: Any, count: int) -> None:
    pipeline = trainer.pipeline
    pipeline.train()

    def prepare(kind: str) -> None:
        pipeline.model.config.compiled = None if kind == "ours" else False

    lines = _measured(trainer, prepare, ("ours", "torch"), 0, count, DRAWING | NETWORK | ADAM)
    kept, size = len(pipeline.model.pruned_scene(0).pruned), pipeline.model.config.size
    print(f"{size} network, {kept:,} Gaussians, CPU seconds a step:", *lines, sep="\n", flush=True)


def _measured(
    trainer: Any,
    prepare: Callable[[str], None],
    kinds: tuple[str, ...],
    step: int,
    count: int,
    parts: dict[str, tuple[str, ...]],
) -> list[str]:
    """Rows of a table: seconds of a step of each kind, and shares of the parts of one of ours.

    Args:
        trainer: whose steps are taken.
        prepare: called with the kind of the next step.
        kinds: ours first.
        step: number of the first step.
        count: number of steps counted of each kind.
        parts: events of torch's profiler by part.
    """
    seconds: dict[str, list[float]] = {kind: [] for kind in kinds}

    def take(kind: str) -> float:
        nonlocal step
        prepare(kind)
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
    ours = median(seconds["ours"])
    lines = [f"| {KINDS[kind]} | {median(taken):.3f} | {median(taken) / ours:.2f} |" for kind, taken in seconds.items()]
    shares = {part: sum(spent_in.get(event, 0.0) for event in events) / total for part, events in parts.items()}
    shares["the rest"] = 1 - sum(shares.values())
    return lines + [f"| {part} | {100 * share:.0f} % |" for part, share in shares.items()]


def main(
    run: tyro.conf.Positional[Path], downscale: tuple[int, ...] = (1,), count: int = 6, refiner: bool = False
) -> None:
    """Print a table for each size of the photos.

    Args:
        run: a finished training of ``splatfacto-cpu``.
        downscale: photos are drawn at so many times fewer pixels a side.
        count: number of steps counted of each kind.
        refiner: steps of a refiner that is trained on this scene.
    """
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        if refiner:
            _refiners_table(_started(pointsplat_config(), run, Path(folder)), count)
            return
        trainer = _trainer(run, Path(folder))
        for factor in downscale:
            trainer.pipeline.model._get_downscale_factor = lambda factor=factor: factor
            _table(trainer, count)


if __name__ == "__main__":
    start(main)
