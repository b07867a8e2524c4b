"""The ``splatfacto-cpu`` method: trains Splatfacto scenes, with or without a GPU."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from nerfstudio.engine.schedulers import ExponentialDecaySchedulerConfig, SchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR

from pointsplat_ns.nerfstudio_plugin.datamanager import LazyImageDatamanagerConfig
from pointsplat_ns.nerfstudio_plugin.optimizers import FusedAdamConfig
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.model import SplatfactoCpuModelConfig
from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.trainer import (
    SplatfactoCpuPipelineConfig,
    SplatfactoCpuTrainer,
)
from pointsplat_ns.nerfstudio_plugin.trainer import StoppableTrainerConfig
from pointsplat_ns.scene.gaussians import PARAMETERS

SPLATFACTO_STEPS = 30_000
"""Training steps that Splatfacto's schedules were chosen for."""


@dataclass
class FallingRate(SchedulerConfig):
    """A learning rate that falls exponentially, in ``max_steps``, from one multiple of the
    optimiser's to another. A training that resumes with another length has that length's rates."""

    first: float = 1.0
    last: float = 1.0
    max_steps: int = 1

    def setup(self) -> FallingRate:  # type: ignore[override]
        """This one: it is its own scheduler."""
        return self

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """torch's scheduler of an optimiser; ``lr_init`` is the optimiser's rate, which it has
        already."""
        ratio = self.last / self.first
        return LambdaLR(
            optimizer, lambda step: self.first * ratio ** min(1.0, step / self.max_steps)
        )


@dataclass
class SplatfactoCpuTrainerConfig(StoppableTrainerConfig):
    """nerfstudio's trainer, with Splatfacto's schedules fitted to the length of the run"""

    _target: type = field(default_factory=lambda: SplatfactoCpuTrainer)
    scale_schedules: bool = True
    """If the run is shorter than 30,000 steps, shorten Splatfacto's schedules (resolution, SH
    degree, densification, learning rates) in proportion, let learning rates begin higher, and the
    scene grow to fewer Gaussians. Options set by hand are not changed."""

    def setup(self, **kwargs) -> Trainer:
        """Build the trainer with a copy of this config whose schedules are fitted to the length.

        A resumed run, and its schedules, end ``max_num_iterations`` after the step that it resumes
        from, as if it had not been stopped.
        """
        self.check()
        fitted = fitted_schedules(self) if self.scale_schedules else copy.deepcopy(self)
        return self.trainer(fitted, **kwargs)


def fitted_schedules(config: SplatfactoCpuTrainerConfig) -> SplatfactoCpuTrainerConfig:
    """A copy of a config with Splatfacto's 30,000-step schedules shortened to its length:
    ``max_num_iterations``, and the steps before if it resumes from a checkpoint.

    Model settings are changed only if they have Splatfacto's default values, learning-rate
    schedules only if they end at 30,000. ``refine_every``, over which gradients are gathered,
    shrinks only below 7,000 steps and never below 25.

    Few steps can train only few Gaussians, and have to take them far. So the learning rates of
    Gaussians begin higher, by the root of how many times shorter the run is, but at most eight
    times, and end as Splatfacto's. The gradient above which a Gaussian is split or duplicated grows
    by the root of that. Gaussians are not split by their size on screen: the small pictures at the
    beginning make all of them look large.
    """
    length = max(1, config.first_step() + config.max_num_iterations)
    share = min(1.0, length / SPLATFACTO_STEPS)
    config = copy.deepcopy(config)
    defaults = SplatfactoCpuModelConfig()
    model = config.pipeline.model
    steps = ["warmup_length", "resolution_schedule", "sh_degree_interval", "stop_split_at"]
    fitted: dict[str, float] = {
        name: max(1, round(share * getattr(defaults, name))) for name in steps
    }
    fitted["refine_every"] = min(defaults.refine_every, max(25, round(length / 70)))
    haste = min(8.0, 1 / math.sqrt(share))
    fitted["densify_grad_thresh"] = math.sqrt(haste) * defaults.densify_grad_thresh
    if share < 1:
        fitted["stop_screen_size_at"] = 0
    for name, value in fitted.items():
        if getattr(model, name) == getattr(defaults, name):
            setattr(model, name, value)
    own = _optimizers()
    for name, group in config.optimizers.items():
        schedule = group["scheduler"]
        if haste > 1 and name in PARAMETERS and group == own[name]:
            last = 1.0 if schedule is None else schedule.lr_final / group["optimizer"].lr
            group["scheduler"] = FallingRate(first=haste, last=last, max_steps=length)
        elif (
            isinstance(schedule, ExponentialDecaySchedulerConfig)
            and schedule.max_steps == SPLATFACTO_STEPS
        ):
            schedule.max_steps = max(1, round(share * SPLATFACTO_STEPS))
            schedule.warmup_steps = round(share * schedule.warmup_steps)
    return config


def _optimizers() -> dict[str, dict[str, Any]]:
    """Splatfacto's optimisers and learning-rate schedules."""

    def group(lr: float, lr_final: float | None = None, **schedule) -> dict[str, Any]:
        decay = ExponentialDecaySchedulerConfig(
            lr_final=lr_final, max_steps=SPLATFACTO_STEPS, **schedule
        )
        return {
            "optimizer": FusedAdamConfig(lr=lr, eps=1e-15),
            "scheduler": decay if lr_final else None,
        }

    return {
        "means": group(1.6e-4, 1.6e-6),
        "features_dc": group(2.5e-3),
        "features_rest": group(2.5e-3 / 20),
        "opacities": group(5e-2),
        "scales": group(5e-3),
        "quats": group(1e-3),
        "camera_opt": group(1e-4, 5e-7, warmup_steps=1000, lr_pre_warmup=0),
        "bilateral_grid": group(2e-3, 1e-4, warmup_steps=1000, lr_pre_warmup=0),
    }


def splatfacto_cpu_config() -> TrainerConfig:
    """The ``splatfacto-cpu`` method: 7,000 steps, the shorter of the two lengths in the 3DGS paper,
    which take a CPU about an hour with small photos. It logs to tensorboard by default, as a viewer
    would compete for the CPU."""
    return SplatfactoCpuTrainerConfig(
        method_name="splatfacto-cpu",
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        max_num_iterations=7000,
        steps_per_save=1000,
        steps_per_eval_batch=0,
        steps_per_eval_image=500,
        steps_per_eval_all_images=0,
        pipeline=SplatfactoCpuPipelineConfig(
            datamanager=LazyImageDatamanagerConfig(
                dataparser=NerfstudioDataParserConfig(load_3D_points=True)
            ),
            model=SplatfactoCpuModelConfig(),
        ),
        optimizers=_optimizers(),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="tensorboard",
    )
