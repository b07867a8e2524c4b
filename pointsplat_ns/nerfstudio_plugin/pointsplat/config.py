"""The ``pointsplat`` method: how the refiner is trained."""

from __future__ import annotations

import copy
import math
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import CosineDecaySchedulerConfig, MultiStepSchedulerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from tyro.conf import Fixed, Suppress

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipelineConfig
from pointsplat_ns.nerfstudio_plugin.pointsplat.trainer import PointSplatTrainer

RATES = {
    "encoder": 1e-4,
    "backbone": 1e-4,
    "means": 1e-4,
    "scales": 1e-4,
    "quats": 1e-4,
    "opacities": 1e-4,
    "features_dc": 1e-4,
    "features_rest": 3e-5,
}
"""Adam's peak learning rate for each part of the network. The published 1e-5 to 3e-5 suit a long training of the full
network. Merged scenes need little repair: trained on two rooms for 300 steps, a third one gained 0.4 dB at 1e-4 and 0.1
at 2e-4, and lost at 3e-4 and above (400 steps), although the two gained more the higher the rate. After the paper's
score, which leaves much to repair, 1e-3 learns faster."""

PAPER_RATES = dict.fromkeys(RATES, 1e-5)
"""The paper's: 1e-5 throughout, divided by 10 (``schedule="step"``) at :data:`STEP_AT` of the steps."""

AUTHORS_RATES = {
    **dict.fromkeys(RATES, 3e-5),
    **dict.fromkeys(("means", "scales", "quats"), 1e-5),
    "features_rest": 1e-6,
}
"""Those of the authors' released code, with its cosine."""

STEP_AT, STEP_FACTOR = 0.6, 0.1
"""Where the step schedule divides the rates by ten, as a share of the steps: 6,000 of 10,000 in the paper."""

WARM_UP = 0.05
"""Share of the steps over which the rates rise to their peak, before the cosine."""


@dataclass
class PointSplatTrainerConfig(TrainerConfig):
    """nerfstudio's trainer, with the learning-rate schedules fitted to the length of the run"""

    _target: type = field(default_factory=lambda: PointSplatTrainer)
    rates: Literal["fast", "paper", "authors"] = "fast"
    """Learning rates of the parts of the network: those that teach a small network in a few hundred steps, the paper's
    (1e-5), or those of the authors' code (1e-6 to 3e-5). What was set by hand is left as it is."""
    rate_factor: float = 1.0
    """Multiplies all learning rates. The fast ones suit merged scenes and few rooms; with ten rooms and more, three
    times as much learns faster and still carries over, and ten times as much after the paper's score."""
    schedule: Literal["cosine", "step"] = "cosine"
    """How the rates fall: along a cosine after a short warm-up, or to a tenth at 60 % of the steps."""
    gradient_accumulation_steps: dict[str, int] = field(default_factory=dict)
    """Steps, each on one scene, whose gradients are averaged before an update: ``all 4``, or by part of the network."""
    max_skipped_steps: int = 10
    """Steps that may be left out because a loss or a gradient is not finite (a broken photo or scene, rates too high),
    in all, before training stops and names the scenes. Counted in all and not in a row: nothing changes at such a step,
    so what is broken is as broken when its turn comes again, and between the turns of one broken scene the others
    would start the count anew for ever."""

    # nerfstudio's setting of text-to-NeRF methods is no option here.
    prompt: Suppress[Fixed[str | None]] = None

    def setup(self, **kwargs) -> Trainer:
        """The trainer, for a copy of this config whose rates are those asked for and whose schedules end with the run.

        A resumed run ends ``max_num_iterations`` after the step that it resumes from, and its schedules with it: what
        was stopped at 500 of 2,000 steps and is resumed for 1,500 goes on exactly as it would have.

        Raises:
            PointSplatError: if the rates are multiplied by something else than a finite number above 0.
        """
        if not 0 < self.rate_factor < math.inf:  # NaN fails too
            raise PointSplatError(f"--rate-factor {self.rate_factor:g}: expected a finite number above 0")
        config = copy.deepcopy(self)
        steps = _steps_done(config) + config.max_num_iterations
        rates = {"fast": RATES, "paper": PAPER_RATES, "authors": AUTHORS_RATES}[self.rates]
        for name, group in config.optimizers.items():
            if group["optimizer"].lr == RATES.get(name):
                group["optimizer"].lr = rates[name]
            group["optimizer"].lr *= self.rate_factor
            schedule = group["scheduler"]
            if isinstance(schedule, CosineDecaySchedulerConfig) and schedule.max_steps == 0:
                if self.schedule == "step":
                    milestones = (max(1, round(STEP_AT * steps)),)
                    group["scheduler"] = MultiStepSchedulerConfig(
                        max_steps=steps, gamma=STEP_FACTOR, milestones=milestones
                    )
                    continue
                schedule.warm_up_end = max(1, round(WARM_UP * steps))
                schedule.max_steps = max(steps, schedule.warm_up_end + 1)  # the cosine divides by what is between
        return self._target(config, **kwargs)


def _steps_done(config: TrainerConfig) -> int:
    """Steps behind the checkpoint that a run is to resume from, by its name; 0 for a new run."""
    if config.load_dir is None:
        return 0 if config.load_checkpoint is None else _step_of(config.load_checkpoint) + 1
    if config.load_step is not None:
        return config.load_step + 1
    return max((_step_of(path) for path in config.load_dir.glob("step-*.ckpt")), default=-1) + 1


def _step_of(checkpoint: Path) -> int:
    match = re.fullmatch(r"step-(\d{1,18})", checkpoint.stem)
    return int(match[1]) if match else -1


def pointsplat_config() -> TrainerConfig:
    """The ``pointsplat`` method: 2,000 steps, which two CPU cores do in less than an hour on small scenes."""
    return PointSplatTrainerConfig(
        method_name="pointsplat",
        machine=MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu"),
        max_num_iterations=2000,
        steps_per_save=500,
        steps_per_eval_batch=0,
        steps_per_eval_image=100,
        steps_per_eval_all_images=0,
        mixed_precision=False,
        pipeline=PointSplatPipelineConfig(),
        optimizers={
            name: {
                "optimizer": AdamOptimizerConfig(lr=rate, eps=1e-15, max_norm=2.0),
                "scheduler": CosineDecaySchedulerConfig(warm_up_end=0, learning_rate_alpha=0.02, max_steps=0),
            }
            for name, rate in RATES.items()
        },
        viewer=ViewerConfig(num_rays_per_chunk=1 << 15),
        vis="tensorboard",
    )
