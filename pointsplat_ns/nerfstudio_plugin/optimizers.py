"""The optimiser of both methods' trainings, and the check of its gradients."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from nerfstudio.engine.optimizers import AdamOptimizerConfig
from torch import Tensor


@dataclass
class FusedAdamConfig(AdamOptimizerConfig):
    """Adam that updates a parameter in one pass over memory, where torch's default makes a dozen"""

    fused: bool = True
    """Use torch's fused implementation. It rounds differently, but computes the same."""


def all_finite(tensors: Iterable[Tensor]) -> bool:
    """Whether all numbers are finite.

    A sum is not finite if a number is not, and is a fifth of the work; where it overflows, numbers are looked at.
    """
    return all(bool(tensor.sum().isfinite()) or bool(tensor.isfinite().all()) for tensor in tensors)
