"""The optimiser of both methods' trainings, and the learning rates of short ones."""

from __future__ import annotations

from dataclasses import dataclass, field

from nerfstudio.engine.optimizers import AdamOptimizerConfig
from nerfstudio.engine.schedulers import Scheduler, SchedulerConfig
from torch.optim import Optimizer
from torch.optim.lr_scheduler import LambdaLR


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam that updates a parameter in one pass over memory, where torch's default makes a dozen"""

    fused: bool = True
    """Use torch's fused implementation. It rounds differently, but computes the same."""


@dataclass
class FallingRateConfig(SchedulerConfig):
    """A learning rate that falls exponentially from one multiple of the optimiser's to another"""

    _target: type = field(default_factory=lambda: FallingRate)
    first: float = 1.0
    """The multiple at the first step."""
    last: float = 1.0
    """The multiple after ``max_steps``, and from then on."""
    max_steps: int = 1
    """Number of steps that the fall takes."""


class FallingRate(Scheduler):
    """See :class:`FallingRateConfig`. Checkpoints hold the optimiser's own rate, so that a training that resumes with
    another length has that length's rates."""

    config: FallingRateConfig

    def get_scheduler(self, optimizer: Optimizer, lr_init: float) -> LambdaLR:
        """torch's scheduler of an optimiser; ``lr_init`` is the optimiser's rate, which it has already."""
        first, last, length = self.config.first, self.config.last, self.config.max_steps
        return LambdaLR(optimizer, lambda step: first * (last / first) ** min(1.0, step / length))
