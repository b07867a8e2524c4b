"""The feedback network: a small network that reads the gradients of each Gaussian, and sets how far
it moves.

The refiner of the paper reads a scene and not its error. This network reads the error: after each
render it gets the gradients of the rendering loss so far, for each Gaussian by itself. Its output
multiplies the steps of Adam by a factor for each parameter, so Gaussians without gradients do not
move. An untrained network gives plain Adam. Such learned optimisers are due to Andrychowicz et al.
(arXiv 1606.04474); G3R (arXiv 2409.19405) and QuickSplat (ICCV 2025) use gradients as the input of
networks that reconstruct scenes.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pointsplat_ns.refinement.network import linear, zero_linear
from pointsplat_ns.refinement.weights import WeightsError, checked_tensors, opened_weights
from pointsplat_ns.scene.gaussians import PARAMETERS
from pointsplat_ns.system.files import write_tensors

FEEDBACK_FORMAT = "pointsplat-feedback/2"

MOST_STEPS = 100_000
"""Maximum number of steps that a file may say its training had."""


class FeedbackRefiner(nn.Module):
    """An MLP on the features of each Gaussian.

    Args:
        most_steps: maximum number of steps of the repairs in its training; longer ones enter the
            network as so many.

    Example:
        >>> FeedbackRefiner()(torch.zeros(5, FeedbackRefiner.FEATURES)).unique().tolist()
        [1.0]
    """

    FEATURES = 39
    """Number of features of a Gaussian, see :mod:`pointsplat_ns.pipeline.feedback_features`."""

    MAX_LOG_FACTOR = 2.0
    """Bound of the factors' logarithms: factors are from 1/7 to 7."""

    def __init__(self, most_steps: int = 32) -> None:
        super().__init__()
        self.most_steps = most_steps
        with torch.device("cpu"):
            self.mlp = nn.Sequential(
                linear(self.FEATURES, 64),
                nn.SiLU(),
                linear(64, 64),
                nn.SiLU(),
                zero_linear(64, len(PARAMETERS)),
            )

    def forward(self, features: Tensor) -> Tensor:
        """Factors of the steps, (N, 6), above 0, in the order of
        :data:`~pointsplat_ns.scene.gaussians.PARAMETERS`, from features (N, :attr:`FEATURES`)."""
        bound = self.MAX_LOG_FACTOR
        return (bound * torch.tanh(self.mlp(features) / bound)).exp()


def save_feedback_refiner(
    network: FeedbackRefiner, path: Path | str, metadata: dict[str, Any] | None = None
) -> None:
    """Write a network, with metadata, which may be anything that JSON can hold: data, command,
    steps, results."""
    header = {
        "format": FEEDBACK_FORMAT,
        "most_steps": str(network.most_steps),
        "metadata": json.dumps(metadata or {}),
    }
    write_tensors(path, network.state_dict(), header)


@lru_cache(maxsize=2)
def shipped_feedback_refiner(device: torch.device) -> FeedbackRefiner:
    """The shipped network on a device; ``pretrained/FEEDBACK.md`` describes its training and
    results."""
    return read_feedback_refiner(Path(__file__).parent / "pretrained" / "feedback.safetensors").to(
        device
    )


def read_feedback_refiner(path: Path | str) -> FeedbackRefiner:
    """Read a network, in evaluation mode. Raises WeightsError if the file is none."""
    path = Path(path)
    network = FeedbackRefiner()
    with opened_weights(path, FEEDBACK_FORMAT, "a feedback refiner") as (file, header):
        steps = header.get("most_steps", "32")
        if not (steps.isdecimal() and 1 <= int(steps[:9]) <= MOST_STEPS):
            raise WeightsError(
                f"{path}: most_steps is {steps[:20]!r}; expected a number from 1 to {MOST_STEPS}"
            )
        network.most_steps = int(steps)
        state = checked_tensors(file, network.state_dict(), path)
    network.load_state_dict(state)
    return network.eval().requires_grad_(requires_grad=False)
