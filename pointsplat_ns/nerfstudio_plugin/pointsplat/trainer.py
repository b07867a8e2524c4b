"""nerfstudio's trainer, for one network trained on many scenes, in one or several processes."""

from __future__ import annotations

import functools
import math
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Literal

import torch
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor, nn
from torch.optim.lr_scheduler import LambdaLR

from pointsplat_ns.compression.repair import rate_factor
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.nerfstudio_plugin.optimizers import all_finite
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline
from pointsplat_ns.nerfstudio_plugin.stopping import StoppableTrainer
from pointsplat_ns.system import processes

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.config import PointSplatTrainerConfig


SECONDS_BETWEEN_CHECKPOINTS = 600.0
"""A training that is killed loses at most this time, however slow its steps are."""


def rate_factor_at(share: float, schedule: Literal["cosine", "step"]) -> float:
    """Learning rate over its peak, when a share of the training has passed. ``cosine``: from 0 linearly to 1 at 5 %,
    then along a cosine to 0.02 at the end. ``step``: 1, and 0.1 from 60 % on (6,000 of 10,000 steps in the paper)."""
    if schedule == "step":
        return 1.0 if share < 0.6 else 0.1
    warm_up, last = 0.05, 0.02
    if share < warm_up:
        return share / warm_up
    return rate_factor(min(1.0, (share - warm_up) / (1 - warm_up)), last)


class AveragingOptimizers(Optimizers):
    """nerfstudio's optimisers, with gradients averaged over processes. ``factor_after`` is the learning rate over its
    peak after a number of steps, for groups whose config has no scheduler."""

    def __init__(
        self,
        config: dict[str, Any],
        param_groups: dict[str, list[nn.Parameter]],
        factor_after: Callable[[int], float],
    ):
        super().__init__(config, param_groups)
        for name, optimizer in self.optimizers.items():
            if name not in self.schedulers:
                self.schedulers[name] = LambdaLR(optimizer, factor_after)

    def optimizer_scaler_step_some(self, grad_scaler, param_groups: list[str]) -> None:
        """As nerfstudio's, with averaged gradients."""
        for group in param_groups:
            processes.average_gradients(self.parameters[group])
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


class PointSplatTrainer(StoppableTrainer):
    """nerfstudio's trainer, with averaged gradients, that skips steps whose loss or gradients are not finite.

    If a loss or a gradient is NaN or infinite in any process, all processes skip the step: it changes neither
    parameters nor the optimisers' state nor running statistics. The step is logged with its scene and
    counted. The learning-rate schedule still advances, as it counts the steps of the run. Checkpoints also come every
    :data:`SECONDS_BETWEEN_CHECKPOINTS`.
    """

    config: PointSplatTrainerConfig
    pipeline: PointSplatPipeline
    clock = staticmethod(time.monotonic)
    """Seconds since any moment."""

    def __init__(self, config, local_rank: int = 0, world_size: int = 1) -> None:
        super().__init__(config, local_rank, world_size)
        self._latest = self.clock()
        self._seconds_of_checkpoint = 0.0
        self._last_step = sys.maxsize

    def setup_optimizers(self) -> AveragingOptimizers:
        """The optimisers. Raises PointSplatError if ``max_skipped_steps`` or ``seconds`` are out of range."""
        if self.config.max_skipped_steps < 0:
            raise PointSplatError(f"--max-skipped-steps {self.config.max_skipped_steps}: expected at least 0")
        if self.config.seconds is not None and not 0 < self.config.seconds < math.inf:  # NaN fails too
            raise PointSplatError(f"--seconds {self.config.seconds:g}: expected a finite number above 0")
        return AveragingOptimizers(
            self.config.optimizers.copy(),
            self.pipeline.get_param_groups(),
            lambda steps: rate_factor_at(self.share(steps), self.config.schedule),
        )

    def share(self, steps: int) -> float:
        """Share of the training that has passed after a number of steps; with ``seconds``, of the time."""
        if self.config.seconds is not None:
            return self.pipeline.training_state.seconds / self.config.seconds
        return steps / max(1, self._start_step + self.config.max_num_iterations)

    def _load_checkpoint(self) -> None:
        """As nerfstudio's. Raises PointSplatError if the training has taken all of ``seconds`` before."""
        super()._load_checkpoint()
        spent, seconds = self.pipeline.training_state.seconds, self.config.seconds
        if seconds is not None and spent >= seconds:
            raise PointSplatError(
                f"--seconds {seconds:g}: the training has taken {spent:.0f} s up to its checkpoint; expected more, as "
                "it is the total"
            )
        self._seconds_of_checkpoint = spent

    def one_step(self, step: int) -> tuple[Tensor, dict[str, Tensor], dict[str, Any]]:
        """As nerfstudio's, but skips a step whose loss or gradients are not finite. With a gradient scaler
        (``--mixed-precision``), the scaler handles gradients that overflow. If more than ``max_skipped_steps`` have
        been skipped, a checkpoint is saved, and a SceneError ends training."""
        pipeline, state = self.pipeline, self.pipeline.training_state
        statistics = [(buffer, buffer.clone()) for buffer in pipeline.model.refiner.buffers()]
        self.optimizers.zero_grad_all()
        device_type = self.device.split(":")[0]
        with torch.autocast(device_type="cpu" if device_type == "mps" else device_type, enabled=self.mixed_precision):
            _, losses, metrics = pipeline.get_train_loss_dict(step=step)
            loss = functools.reduce(torch.add, losses.values())
        faults = metrics.pop("faults")
        skip = processes.any_rank(bool(faults), self.device)
        if not skip:
            self.grad_scaler.scale(loss).backward()
            faults = [] if self.grad_scaler.is_enabled() else self._faults_of_gradients()
            skip = processes.any_rank(bool(faults), self.device)
        if skip:
            self._forget(statistics)
            self._count(step, pipeline.datamanager.scenes[metrics["scene"]].name, faults)
        self._update(step, skip)
        metrics["skipped_steps"] = state.skipped.total()
        if self.config.log_gradients:
            norms = {n: p.grad.norm() for n, p in pipeline.model.named_parameters() if p.grad is not None}
            metrics |= {f"Gradients/{name}": norm for name, norm in norms.items()}
            metrics["Gradients/Total"] = sum(norms.values())
        if skip and state.skipped.total() > self.config.max_skipped_steps:
            self._stop(step)
        if state.seconds - self._seconds_of_checkpoint >= SECONDS_BETWEEN_CHECKPOINTS:
            self.save_checkpoint(step)
        return loss, losses, metrics

    def _count_seconds(self, step: int) -> None:
        """Count the time since the step before, and end the training after this one if the time is over. The first
        process's clock counts in all."""
        state, now = self.pipeline.training_state, self.clock()
        (state.seconds, *_), self._latest = processes.gathered([state.seconds + now - self._latest]), now
        if self.config.seconds is None:
            return
        share = self.share(step)
        # nerfstudio says the time left by the number of steps.
        writer.GLOBAL_BUFFER["max_iter"] = round((step + 1) / min(share, 1.0)) if share > 0 else sys.maxsize
        if share >= 1:
            self.stop_training, self._last_step = True, step
            CONSOLE.log(f"the time is over: {step + 1} steps in {state.seconds:.0f} s")

    def _after_train(self) -> None:
        """As nerfstudio's, which counts the step before which it stops as done."""
        self.step = min(self.step, self._last_step)
        super()._after_train()

    def train(self) -> None:
        """As nerfstudio's. The first step waits for its scene alone."""
        manager = self.pipeline.datamanager
        if processes.rank() == 0 and len(manager.train_indices) > 1:
            name = manager.scenes[manager.scene_at(self._start_step)].name
            CONSOLE.log(f"preparing {name} for the first step, then the other scenes while steps are taken")
        super().train()

    def end_background(self) -> None:
        """End the preparation of further scenes."""
        self.pipeline.datamanager.background.stop()

    def _faults_of_gradients(self) -> list[str]:
        """One text for each part of the network with a gradient that is not finite."""
        faults = []
        for name, parameters in self.optimizers.parameters.items():
            if not all_finite(p.grad for p in parameters if p.grad is not None):
                faults.append(f"the gradient of the {name} is not finite")
        return faults

    @torch.no_grad()
    def _forget(self, statistics: list[tuple[Tensor, Tensor]]) -> None:
        """Undo a step: clear the gradients and restore the running statistics."""
        self.optimizers.zero_grad_all()
        for buffer, before in statistics:
            buffer.copy_(before)

    def _count(self, step: int, scene: str, faults: list[str]) -> None:
        """Count and log the scenes, of all processes, that made a step be skipped."""
        faulty = processes.gathered([(scene, "; ".join(faults))] if faults else [])
        skipped = self.pipeline.training_state.skipped
        for name, text in faulty:
            skipped[name] += 1
            if processes.rank() == 0:
                total, most = skipped.total(), self.config.max_skipped_steps
                CONSOLE.log(f"step {step} is skipped: {name}: {text} ({total} skipped so far; more than {most} stop)")

    def _update(self, step: int, skip: bool) -> None:
        """Step the optimisers, unless the step is skipped, the clock, and all schedules."""
        self._count_seconds(step)
        scale = self.grad_scaler.get_scale()
        if not skip:
            self.optimizers.optimizer_scaler_step_some(self.grad_scaler, list(self.optimizers.parameters))
            self.grad_scaler.update()
        if scale <= self.grad_scaler.get_scale():  # as in nerfstudio: not if the scaler skipped the update
            self.optimizers.scheduler_step_all(step)

    def _stop(self, step: int) -> None:
        """Save a checkpoint and end training with an error that names the scenes."""
        self.save_checkpoint(step)
        skipped = self.pipeline.training_state.skipped
        scenes = ", ".join(f"{name}: {count}" for name, count in skipped.most_common())
        raise SceneError(
            f"training stopped at step {step}: losses or gradients were not finite in {skipped.total()} steps, "
            f"which were skipped ({scenes}); repair these scenes and their photos or leave them out, or, if most "
            "scenes are named, lower the learning rates; then go on with --load-dir "
            f"{self.checkpoint_dir} and a higher --max-skipped-steps than {self.config.max_skipped_steps}"
        )

    def save_checkpoint(self, step: int) -> None:
        """As nerfstudio's; all processes call it, the first one writes."""
        super().save_checkpoint(step)
        self._seconds_of_checkpoint = self.pipeline.training_state.seconds
