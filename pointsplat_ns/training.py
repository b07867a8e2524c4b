"""nerfstudio's trainer, for one network over many scenes and perhaps several processes."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import Any

from nerfstudio.engine.optimizers import Optimizers
from torch import nn

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.parallel import average_gradients
from pointsplat_ns.pipeline import PointSplatPipeline
from pointsplat_ns.splatfacto_cpu_method import SplatfactoCpuTrainer

ALL = "all"
"""Stands for every part of the network in ``gradient_accumulation_steps``."""


class AveragingOptimizers(Optimizers):
    """nerfstudio's optimisers, which step along the mean of the gradients over accumulated steps and processes.

    nerfstudio adds gradients up; their norm, and what clipping makes of it, would then depend on how many there are.

    Args:
        config, param_groups: as nerfstudio's.
        accumulation: steps that gradients gather over, by group.
    """

    def __init__(
        self, config: dict[str, Any], param_groups: dict[str, list[nn.Parameter]], accumulation: Mapping[str, int]
    ):
        super().__init__(config, param_groups)
        self._accumulation = accumulation

    def optimizer_scaler_step_some(self, grad_scaler, param_groups: list[str]) -> None:
        """As nerfstudio's, with averaged gradients."""
        for group in param_groups:
            average_gradients(self.parameters[group], self._accumulation[group])
        super().optimizer_scaler_step_some(grad_scaler, param_groups)


class PointSplatTrainer(SplatfactoCpuTrainer):
    """nerfstudio's trainer, with averaged gradients; a checkpoint between two updates holds what has gathered."""

    pipeline: PointSplatPipeline

    def __init__(self, config, local_rank: int = 0, world_size: int = 1) -> None:
        super().__init__(config, local_rank, world_size)
        steps = self.config.gradient_accumulation_steps
        self.gradient_accumulation_steps = defaultdict(lambda: steps.get(ALL, 1), steps)

    def setup_optimizers(self) -> AveragingOptimizers:
        """The optimisers.

        Raises:
            PointSplatError: if gradients are to gather over no step, or in a part that the network does not have.
        """
        groups = self.pipeline.get_param_groups()
        for name, steps in self.config.gradient_accumulation_steps.items():
            if name not in (*groups, ALL) or steps < 1:
                raise PointSplatError(
                    f"--gradient-accumulation-steps {name} {steps}: expected {ALL} or one of {', '.join(groups)}, and "
                    "at least 1"
                )
        return AveragingOptimizers(self.config.optimizers.copy(), groups, self.gradient_accumulation_steps)

    def save_checkpoint(self, step: int) -> None:
        """As nerfstudio's; called in all processes, written by the first."""
        parts = self.optimizers.parameters
        waiting = [name for name in parts if (step + 1) % self.gradient_accumulation_steps[name]]
        for name in waiting:
            average_gradients(parts[name])  # over processes: what they have gathered becomes one
        with self.pipeline.saving_gradients(waiting):
            super().save_checkpoint(step)
