"""The ``pointsplat`` method: how the refiner is trained."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Literal, cast

import torch
from nerfstudio.configs.base_config import (
    LocalWriterConfig,
    LoggingConfig,
    MachineConfig,
    ViewerConfig,
)
from nerfstudio.engine.trainer import Trainer
from nerfstudio.utils.writer import LocalWriter
from tyro.conf import Fixed, Suppress

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.optimizers import FusedAdamConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.model import PointSplatModelConfig, take_network_of
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipelineConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.resuming import take_settings_of
from pointsplat_ns.nerfstudio_plugin.pointsplat.trainer import PointSplatTrainer
from pointsplat_ns.nerfstudio_plugin.pointsplat.verdict import selection_text
from pointsplat_ns.nerfstudio_plugin.trainer import StoppableTrainerConfig
from pointsplat_ns.scene.runs import METHOD_NAMES
from pointsplat_ns.system.processes import (
    connect_torchrun,
    gathered,
    local_rank,
    rank,
    torchrun_rank,
)
from pointsplat_ns.system.terminal import say

REFINER_RATES = {
    "encoder": 1e-4,
    "backbone": 1e-4,
    "means": 1e-4,
    "scales": 1e-4,
    "quats": 1e-4,
    "opacities": 1e-4,
    "features_dc": 1e-4,
    "features_rest": 3e-5,
}
"""Adam's peak learning rate for each part of the network. The published 1e-5 to 3e-5 suit a long
training of the full network. Merged scenes need little repair, and high rates overfit: after 300
steps on two rooms, a third room gained 0.4 dB at 1e-4 and 0.1 dB at 2e-4, and lost at 3e-4."""

SELECTION_RATE_FACTOR = 10.0
"""Factor on these rates for scenes that a score selects, which need more repair: after 150 steps on
three captures at 10 %, ``small`` gains 1.7 dB in fixed views of them at 1, and 2.7 dB at 10."""


class SilentWriter(LocalWriter):
    """In place of nerfstudio's table of rays per second: the trainer prints its own lines."""

    def write_stats_log(self, step: int) -> None:
        """Print nothing."""


ENDLESS = 1 << 40
"""A number of steps that no time allows; with more added to it, tensorboard can count to it."""


@dataclass
class PointSplatTrainerConfig(StoppableTrainerConfig):
    """nerfstudio's trainer, for a number of steps or for a time"""

    _target: type = field(default_factory=lambda: PointSplatTrainer)
    seconds: float | None = None
    """Train for this time, in place of max_num_iterations: as many steps as fit, with a schedule
    that ends with it. The time before the checkpoint of load_dir is part of it."""
    rate_factor: float | None = None
    """Multiplies all learning rates. By default 10 for scenes that a score selects, and 1 for
    merged ones; with ten merged rooms or more, 3 learns faster and still generalises."""
    schedule: Literal["cosine", "step"] = "cosine"
    """How the rates fall: along a cosine after a short warm-up, or to a tenth at once."""
    drop_at: float = 0.6
    """Share of the steps or of the time after which the schedule step has a tenth of the rates (the
    paper: 0.6)."""
    global_norm: float | None = None
    """Largest norm of all gradients together, in place of each optimiser's max-norm for its own
    part."""

    init: str | None = None
    """Start from the weights of a trained refiner, and take the options of its network: shipped,
    which has one for merging and one for selections, a .safetensors file, or a run."""

    steps_per_eval_image: int = 100
    """After so many steps, fixed views of each scene are measured, pruned and refined, held-out
    scenes apart: in a line, in tensorboard and in training.csv. Less often if it would take more
    than a twentieth of the time; 0 for never."""
    steps_per_eval_batch: Suppress[Fixed[int]] = 0  # nerfstudio's, without effect here

    @property
    def model_config(self) -> PointSplatModelConfig:
        """Settings of the model."""
        return cast(PointSplatModelConfig, self.pipeline.model)

    @staticmethod
    def usual_model(method: str | None) -> PointSplatModelConfig:
        """Settings of the model that a method has if none is given."""
        from nerfstudio.configs.method_configs import all_methods  # which import this module

        config = all_methods.get(method or "")
        if isinstance(config, PointSplatTrainerConfig):
            return copy.deepcopy(config.model_config)
        return PointSplatModelConfig()

    def check(self) -> None:
        """See the base class. A training that resumes takes settings of its checkpoint's run."""
        kind = self.machine.device_type
        number = self.machine.num_devices
        if kind != "cuda" and number > 1:
            raise PointSplatError(
                f"--machine.num-devices {number} is for GPUs; expected 1, or processes on a CPU "
                "that are started by "
                f"torchrun --nproc-per-node {number} --no-python ns-train {self.method_name}"
            )
        if self.machine.seed != MachineConfig().seed:
            raise PointSplatError(
                f"--machine.seed {self.machine.seed} has no effect here; expected "
                f"--pipeline.datamanager.seed {self.machine.seed}, which determines the "
                "initial weights, the order of scenes and photos, and the pieces"
            )
        for name in ("rate_factor", "drop_at", "seconds", "global_norm"):
            value = getattr(self, name)
            if value is not None and not 0 < value < math.inf:  # NaN fails too
                raise PointSplatError(
                    f"--{name.replace('_', '-')} {value:g}: expected a finite number above 0"
                )
        super().check()
        model = self.model_config
        checkpoint = self.checkpoint_to_load()
        if checkpoint is not None:
            take_settings_of(checkpoint, model, self.usual_model(self.method_name))
        for keep in (model.keep, *model.more_keeps):
            model.prune_settings(keep)
        if self.rate_factor is None:
            self.rate_factor = 1.0 if model.by == "merge" else SELECTION_RATE_FACTOR

    def set_timestamp(self) -> None:
        """See the base class; processes that ``torchrun`` started are connected here."""
        if self.init is not None:
            assert isinstance(self.pipeline, PointSplatPipelineConfig)
            take_network_of(self.init, self.pipeline.model)
        super().set_timestamp()
        connect_torchrun("nccl" if self.machine.device_type == "cuda" else "gloo")

    def print_to_terminal(self) -> None:
        """As nerfstudio's, by the first process; before, how scenes are pruned."""
        if rank() == 0:
            say(selection_text(self.model_config.prune_settings()), flush=True)
            super().print_to_terminal()

    def save_config(self) -> None:
        """See the base class; all processes take the folder of the first."""
        super().save_config()
        self.timestamp = gathered([self.timestamp])[0]

    def setup(self, **kwargs) -> Trainer:
        """Build the trainer with a copy of this config whose rates and limits of gradients are set.

        A resumed run, and its schedules, end ``max_num_iterations`` after the step that it resumes
        from, or when ``seconds`` are over, as if it had not been stopped.
        """
        self.check()
        config = copy.deepcopy(self)
        if config.seconds is not None:
            config.max_num_iterations = ENDLESS
        assert config.rate_factor is not None  # set by check()
        for group in config.optimizers.values():
            group["optimizer"].lr *= config.rate_factor
            if self.global_norm is not None:
                group["optimizer"].max_norm = None
        _, together = torchrun_rank()
        if together > 1:  # nerfstudio, which did not start them, takes each for one alone
            kwargs |= {"local_rank": local_rank(), "world_size": together}
        return self.trainer(config, **kwargs)


def adam(rates: dict[str, float], eps: float, max_norm: float | None = None) -> dict[str, dict]:
    """Adam for each part of the network by its rate; the schedules are the trainer's own."""
    optimizers = {
        name: FusedAdamConfig(lr=rate, eps=eps, max_norm=max_norm) for name, rate in rates.items()
    }
    return {
        name: {"optimizer": optimizer, "scheduler": None} for name, optimizer in optimizers.items()
    }


def pointsplat_config() -> PointSplatTrainerConfig:
    """The ``pointsplat`` method: 2,000 steps, which take two CPU cores less than an hour on small
    scenes."""
    return PointSplatTrainerConfig(
        method_name=METHOD_NAMES.refiner,
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        max_num_iterations=2000,
        steps_per_save=500,
        steps_per_eval_image=100,
        steps_per_eval_all_images=0,
        pipeline=PointSplatPipelineConfig(),
        optimizers=adam(REFINER_RATES, eps=1e-15, max_norm=2.0),
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        logging=LoggingConfig(
            local_writer=LocalWriterConfig(_target=SilentWriter, enable=True), profiler="none"
        ),
        vis="tensorboard",
    )
