"""nerfstudio's trainer, for one scene."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from nerfstudio.pipelines.base_pipeline import VanillaPipeline, VanillaPipelineConfig

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanager
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import LpipsMetric
from pointsplat_ns.nerfstudio_plugin.trainer import StoppableTrainer
from pointsplat_ns.system.tensors import FLOATS

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import SplatfactoCpuTrainerConfig


FRAMES_TO_COME = ("train_unseen_cameras", "eval_unseen_cameras")
"""Attributes of the datamanager: the frames that are still to come before any is repeated."""


@dataclass
class SplatfactoCpuPipelineConfig(VanillaPipelineConfig):
    """nerfstudio's pipeline"""

    _target: type = field(default_factory=lambda: SplatfactoCpuPipeline)


class SplatfactoCpuPipeline(VanillaPipeline):
    """nerfstudio's pipeline. A metric that cannot be computed is null in its evaluation, never
    NaN."""

    datamanager: LazyImageDatamanager

    def __init__(self, config: SplatfactoCpuPipelineConfig, *args: Any, **kwargs: Any):
        super().__init__(config, *args, **kwargs)
        cameras = self.datamanager.train_dataset.cameras
        side = int(torch.cat([cameras.width, cameras.height]).min())
        if side < 1:
            raise DataError(
                f"{self.datamanager.get_datapath()}: photos of {side} pixels once they are scaled; "
                "expected at least 1: change --downscale-factor or "
                "--pipeline.datamanager.camera-res-scale-factor"
            )
        most = side.bit_length() - 1
        downscales: int = getattr(config.model, "num_downscales", 0)
        if downscales > most:
            raise PointSplatError(
                f"--pipeline.model.num-downscales {downscales}: the shortest side of the photos is "
                f"{side} pixels, and nothing would be left of it; expected {most} at most"
            )

    def get_average_eval_image_metrics(
        self, step: int | None = None, output_path: Path | None = None, get_std: bool = False
    ) -> dict[str, Any]:
        """Mean metrics over the held-out frames; a DataError if no frame is held out. Given a
        ``step``, by the trainer, whose log takes only finite numbers, other metrics are left out.
        Without it, as in ``ns-eval``, they are None, and ``lpips_note`` says why LPIPS is
        missing."""
        if not self.datamanager.eval_dataset:
            raise DataError(
                f"{self.datamanager.get_datapath()}: no frame is held out, so there is nothing to "
                "evaluate on; expected at least one: change the dataparser's split"
            )
        self.model.lpips = lpips = (
            LpipsMetric()
        )  # a new one, so that its reason is of this evaluation
        metrics = super().get_average_eval_image_metrics(step, output_path, get_std)
        if step is not None:
            return {name: value for name, value in metrics.items() if math.isfinite(value)}
        report: dict[str, Any] = {
            name: value if math.isfinite(value) else None for name, value in metrics.items()
        }
        if lpips.reason is not None:
            report |= {"lpips": None, "lpips_note": lpips.reason}
        return report


class SplatfactoCpuTrainer(StoppableTrainer):
    """The trainer of one scene. A skipped step also leaves alone what densification gathers."""

    config: SplatfactoCpuTrainerConfig
    pipeline: SplatfactoCpuPipeline

    def train(self) -> None:
        """As nerfstudio's."""
        with tiny_as_zero():
            super().train()

    def update(self, step: int, skipped: bool) -> None:
        """As the base class; densification gathers nothing of a skipped step."""
        if skipped:
            self.pipeline.model.forget_step()
        super().update(step, skipped)

    def source_of(self, metrics: dict[str, Any]) -> str:
        """Name of the photo of the latest step."""
        return self.pipeline.datamanager.latest_photo

    def state_to_resume(self) -> dict[str, Any]:
        """Random numbers to come, the order of the photos, and what densification has gathered, as
        plain values and tensors that torch loads with ``weights_only``."""
        manager: Any = self.pipeline.datamanager
        kind, keys, *rest = np.random.get_state()
        state: dict[str, Any] = {
            "torch": torch.get_rng_state(),
            "python": random.getstate(),
            "numpy": [kind, torch.from_numpy(np.asarray(keys, np.int64)), *rest],
            "densification": dict(self.pipeline.model.strategy_state),
            **{name: list(getattr(manager, name)) for name in FRAMES_TO_COME},
        }
        if hasattr(manager, "random_generator"):  # of the order of the training frames
            state["frames"] = manager.random_generator.getstate()
        return state

    def put_back(self, state: Any) -> None:
        """See the base class. Of another number of photos, their order is left alone."""
        if state is None:  # those of nerfstudio's own methods have none
            return
        torch.set_rng_state(state["torch"])
        random.setstate(state["python"])
        kind, keys, *rest = state["numpy"]
        np.random.set_state((kind, keys.numpy().astype(np.uint32), *rest))
        model = self.pipeline.model
        manager = self.pipeline.datamanager
        for name, value in state["densification"].items():
            model.strategy_state[name] = (
                value.clone().to(model.device) if isinstance(value, torch.Tensor) else value
            )
        numbers = len(manager.train_dataset), len(manager.eval_dataset)
        lists = [state[name] for name in FRAMES_TO_COME]
        if all(
            0 <= index < number
            for number, indices in zip(numbers, lists, strict=True)
            for index in indices
        ):
            for name, indices in zip(FRAMES_TO_COME, lists, strict=True):
                setattr(manager, name, list(indices))
            if "frames" in state and hasattr(manager, "random_generator"):
                manager.random_generator.setstate(state["frames"])


@contextmanager
def tiny_as_zero() -> Iterator[None]:
    """Within, this thread, and those it starts, take floats below the smallest normal one (1e-38)
    as 0. Many processors take ten times as long for such numbers. Adam's averages are full of them
    where a Gaussian has not been seen for 800 steps: they fall by a tenth with each."""
    before = takes_tiny_as_zero()
    torch.set_flush_denormal(True)
    try:
        yield
    finally:
        torch.set_flush_denormal(before)


def takes_tiny_as_zero() -> bool:
    """Whether this thread takes floats below the smallest normal one as 0."""
    return not torch.tensor(1e-30, **FLOATS).mul(1e-10).item()
