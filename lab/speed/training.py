"""Where a step of a training goes, and what compiled kernels save.

    python -m lab.speed.training outputs/kitchen/splatfacto-cpu/RUN --downscale 1 2
    python -m lab.speed.training outputs/kitchen/splatfacto-cpu/RUN --refiner

Steps of ``splatfacto-cpu`` continue from the end of a finished training whose photos are at hand,
at its number of Gaussians; those of a refiner begin with a new network on that scene. They
alternate between ours and ours without compiled kernels, so that a busy moment hits both. CPU
seconds of one thread are counted, and nothing is saved.
"""

from __future__ import annotations

import itertools
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import torch
import tyro
from torch.profiler import ProfilerActivity, profile

import pointsplat_ns as ps
from lab.common.printing import markdown, percent, start
from pointsplat_ns.nerfstudio_plugin.pointsplat.config import pointsplat_config
from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import dataparser_of
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config
from pointsplat_ns.scene.runs import open_run

DRAWING = {
    "blending": ("Blend",),
    "blending, backward": ("BlendBackward",),
    "projection": ("CompiledProject", "Project"),
    "projection, backward": ("CompiledProjectBackward", "ProjectBackward"),
    "colours by SH, both ways": (
        "CompiledColor",
        "CompiledColorBackward",
        "Color",
        "ColorBackward",
    ),
    "SSIM, both ways": ("CompiledSimilarity", "CompiledSimilarityBackward"),
}
"""Events of torch's profiler that are a part of a step."""

NETWORK = {
    "linear layers, both ways": ("aten::linear", "AddmmBackward0"),
    "attention, both ways": (
        "aten::scaled_dot_product_attention",
        "ScaledDotProductFlashAttentionForCpuBackward0",
    ),
    "sparse convolutions, both ways": ("_SubmanifoldConv", "_SubmanifoldConvBackward"),
}
"""And those of a refiner."""

ADAM = {"Adam": ("Optimizer.step#Adam.step",)}

WARM_UP = 2
"""Steps that are not counted."""


def _trainer(run: Path, folder: Path) -> Any:
    """nerfstudio's trainer of the run's data, with its Gaussians, all SH bands and no
    densification."""
    config = splatfacto_cpu_config()
    config.pipeline.datamanager.dataparser = dataparser_of(open_run(run)).config  # type: ignore[attr-defined]
    trainer = _started(config, None, folder)
    model = trainer.pipeline.model
    for name, value in ps.load(run).items():
        model.gauss_params[name] = torch.nn.Parameter(value)
    model._adopt_optimizers(trainer.optimizers)
    model.optimizers = trainer.optimizers.optimizers
    model.step = config.max_num_iterations
    model.train()
    return trainer


def _started(config: Any, data: Path | None, folder: Path) -> Any:
    """nerfstudio's trainer of a config before its first step, on a CPU."""
    config.machine.device_type = "cpu"
    config.output_dir = folder
    config.vis = "tensorboard"
    config.data = config.pipeline.datamanager.data = data
    config.set_timestamp()
    trainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    return trainer


def _measured(trainer: Any, step: int, count: int, parts: dict[str, tuple[str, ...]]) -> str:
    """Seconds of a step with and without compiled kernels, and shares of the parts of one with
    them, as a table.

    Args:
        trainer: whose steps are taken.
        step: number of the first step.
        count: number of steps counted of each kind.
        parts: events of torch's profiler by part.
    """
    kinds = {"ours": None, "drawn by torch, without a compiler": False}
    seconds: dict[str, list[float]] = {kind: [] for kind in kinds}
    steps = itertools.count(step)

    def take(kind: str) -> float:
        trainer.pipeline.model.config.compiled = kinds[kind]
        start = time.process_time()
        trainer.train_iteration(next(steps))
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
    shares = {
        part: sum(spent_in.get(event, 0.0) for event in events) / total
        for part, events in parts.items()
    }
    shares["the rest"] = 1 - sum(shares.values())
    ours = median(seconds["ours"])
    lines = [
        [kind, f"{median(taken):.3f}", f"{median(taken) / ours:.2f}"]
        for kind, taken in seconds.items()
    ]
    lines += [[part, percent(round(share, 2)), ""] for part, share in shares.items()]
    return markdown(["a step", "CPU s, or share", "ratio"], lines)


def main(
    run: tyro.conf.Positional[Path],
    downscale: tuple[int, ...] = (1,),
    count: int = 6,
    refiner: bool = False,
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
            trainer = _started(pointsplat_config(), run, Path(folder))
            model = trainer.pipeline.train().model
            text = _measured(trainer, 0, count, DRAWING | NETWORK | ADAM)
            print(
                f"{model.config.size} network, {len(model.pruned_scene(0).pruned):,} "
                f"Gaussians:\n\n{text}"
            )
            return
        trainer = _trainer(run, Path(folder))
        model = trainer.pipeline.model
        for factor in downscale:
            model._get_downscale_factor = lambda factor=factor: factor
            text = _measured(trainer, trainer.config.max_num_iterations, count, DRAWING | ADAM)
            height, width = model.last_size
            print(f"{width} x {height}, {len(model.means):,} Gaussians:\n\n{text}\n", flush=True)


if __name__ == "__main__":
    start(main)
