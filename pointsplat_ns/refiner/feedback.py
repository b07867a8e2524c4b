"""The feedback refiner: a small network that sees what renders say of each Gaussian, and sets how far it moves.

The refiner of the paper sees a scene and not its error. This one sees the error: after each render it is given, for
every Gaussian by itself, what the gradients of the rendering loss have been so far. It multiplies the steps of Adam, by
kind of parameter, so that nothing moves where no gradient says so. Untrained it changes nothing, and what remains is
Adam. Such learned optimisers are due to Andrychowicz et al. (arXiv 1606.04474); G3R (arXiv 2409.19405) and QuickSplat
(ICCV 2025) use gradients as the input of networks that reconstruct scenes.
"""

from __future__ import annotations

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from pointsplat_ns.io.files import write_tensors
from pointsplat_ns.refiner.weights import checked_tensors, opened_weights

PARAMETERS = ("means", "scales", "quats", "opacities", "features_dc", "features_rest")
"""Kinds of parameters, each of which has a factor."""

FEATURES = 39
"""Numbers that the network sees of a Gaussian, see :mod:`pointsplat_ns.compression.feedback`."""

REACH = 2.0
"""Bound of the logarithms of the factors: from 1/7 to 7."""

FORMAT = "pointsplat-feedback/2"

PRETRAINED = Path(__file__).parent / "pretrained" / "feedback.safetensors"
"""The network that ships; ``CARD.md`` beside it describes its training and results."""


class FeedbackRefiner(nn.Module):
    """An MLP that every Gaussian goes through by itself.

    Example:
        >>> FeedbackRefiner()(torch.zeros(5, FEATURES)).unique().tolist()
        [1.0]
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        width = FEATURES
        for _ in range(2):
            layers += [nn.Linear(width, 64), nn.SiLU()]
            width = 64
        last = nn.Linear(width, len(PARAMETERS))
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        self.mlp = nn.Sequential(*layers, last)

    def forward(self, features: Tensor) -> Tensor:
        """Factors of the steps, (N, 6) above 0, one a kind of :data:`PARAMETERS`.

        Args:
            features: (N, :data:`FEATURES`).
        """
        return (REACH * torch.tanh(self.mlp(features) / REACH)).exp()


def save_feedback_refiner(network: FeedbackRefiner, path: Path | str, metadata: dict[str, Any] | None = None) -> None:
    """Write a network.

    Args:
        network: on any device.
        path: the .safetensors file to write or replace; its folder is created if missing.
        metadata: anything JSON can hold: data, command, steps, results.
    """
    write_tensors(path, network.state_dict(), {"format": FORMAT, "metadata": json.dumps(metadata or {})})


def read_feedback_refiner(path: Path | str = PRETRAINED, device: torch.device | str = "cpu") -> FeedbackRefiner:
    """Read a network, in evaluation mode; by default the one that ships.

    Raises:
        WeightsError: if the file is missing, damaged or of another kind.
    """
    path, network = Path(path), FeedbackRefiner()
    with opened_weights(path, FORMAT, "a feedback refiner") as (file, _):
        state = checked_tensors(file, network.state_dict(), path)
    network.load_state_dict(state)
    return network.to(device).eval().requires_grad_(requires_grad=False)


@lru_cache(maxsize=2)
def shipped_feedback_refiner(device: torch.device) -> FeedbackRefiner:
    """The network that ships, read once a device."""
    return read_feedback_refiner(device=device)
