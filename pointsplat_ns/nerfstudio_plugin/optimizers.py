"""The optimiser of both methods' trainings."""

from __future__ import annotations

from dataclasses import dataclass

from nerfstudio.engine.optimizers import AdamOptimizerConfig


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam that updates a parameter in one pass over memory, where torch's default makes a dozen"""

    fused: bool = True
    """Use torch's fused implementation. It rounds differently, but computes the same."""
