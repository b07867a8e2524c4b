"""The trainer of one network on many scenes, in one or several processes."""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any, Literal

from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.utils import writer
from torch.nn.utils import clip_grad_norm_
from torch.optim.lr_scheduler import LambdaLR

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.pointsplat.pipeline import PointSplatPipeline
from pointsplat_ns.nerfstudio_plugin.trainer import StoppableTrainer
from pointsplat_ns.refinement.schedules import cosine_factor
from pointsplat_ns.system import processes

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.config import PointSplatTrainerConfig


def rate_factor_at(
    share: float, schedule: Literal["cosine", "step"], drop_at: float = 0.6
) -> float:
    """Learning rate over its peak, when a share of the training has passed. ``cosine``: from 0
    linearly to 1 at 5 %, then along a cosine to 0.02 at the end. ``step``: 1, and 0.1 from the
    share ``drop_at`` on."""
    if schedule == "step":
        return 1.0 if share < drop_at else 0.1
    warm_up = 0.05
    last = 0.02
    if share < warm_up:
        return share / warm_up
    return cosine_factor(min(1.0, (share - warm_up) / (1 - warm_up)), last)


class PointSplatTrainer(StoppableTrainer):
    """Trains for a number of steps or for a time."""

    config: PointSplatTrainerConfig
    pipeline: PointSplatPipeline
    clock = staticmethod(time.monotonic)
    """Seconds since any moment."""
    _last_step = sys.maxsize

    def __init__(self, config, local_rank: int = 0, world_size: int = 1) -> None:
        super().__init__(config, local_rank, world_size)
        self._latest = self.clock()

    def setup_optimizers(self) -> Optimizers:
        """The optimisers, and the schedules of those that have none of their own."""
        optimizers = super().setup_optimizers()
        for name, optimizer in optimizers.optimizers.items():
            if name not in optimizers.schedulers:
                optimizers.schedulers[name] = LambdaLR(
                    optimizer,
                    lambda steps: rate_factor_at(
                        self.share(steps), self.config.schedule, self.config.drop_at
                    ),
                )
        return optimizers

    def share(self, steps: int) -> float:
        """Share of the training that has passed after a number of steps; with ``seconds``, of the
        time."""
        if self.config.seconds is not None:
            return self.pipeline.seconds / self.config.seconds
        return steps / max(1, self._start_step + self.config.max_num_iterations)

    def _load_checkpoint(self) -> None:
        """As nerfstudio's. Raises PointSplatError if the training has taken all of ``seconds``
        before."""
        super()._load_checkpoint()
        spent = self.pipeline.seconds
        seconds = self.config.seconds
        if seconds is not None and spent >= seconds:
            raise PointSplatError(
                f"--seconds {seconds:g}: the training has taken {spent:.0f} s up to its "
                "checkpoint; expected more, as it is the total"
            )

    def update(self, step: int, skipped: bool) -> None:
        """As the base class. Before, count the time since the step before, and end the training
        after this one if the time is over. The first process's clock counts in all."""
        pipeline = self.pipeline
        now = self.clock()
        (pipeline.seconds, *_), self._latest = (
            processes.gathered([pipeline.seconds + now - self._latest]),
            now,
        )
        if self.config.seconds is not None:
            share = self.share(step)
            # nerfstudio says the time left by the number of steps.
            writer.GLOBAL_BUFFER["max_iter"] = (
                round((step + 1) / min(share, 1.0)) if share > 0 else sys.maxsize
            )
            if share >= 1:
                self.stop_training = True
                self._last_step = step
                log(f"the time is over: {step + 1} steps in {pipeline.seconds:.0f} s")
        super().update(step, skipped)

    def clip(self) -> None:
        """Scale all gradients down to the norm ``global_norm`` of the config, if it is set and they
        exceed it."""
        if self.config.global_norm is not None:
            groups = [self._trained(name) for name in self.optimizers.optimizers]
            clip_grad_norm_([p for group in groups for p in group], self.config.global_norm)

    def _after_train(self) -> None:
        """As nerfstudio's, which counts the step before which it stops as done."""
        self.step = min(self.step, self._last_step)
        super()._after_train()

    def source_of(self, metrics: dict[str, Any]) -> str:
        """Name of the scene of the latest step."""
        return self.pipeline.datamanager.scenes[metrics["scene"]].name
