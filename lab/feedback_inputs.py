"""Further inputs of a feedback network, to measure what they bring: neighbours, and members."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lab.feedback_pieces import MEMBERS, Piece
from pointsplat_ns.geometry.neighbours import nearest
from pointsplat_ns.refinement.feedback import FeedbackRefiner
from pointsplat_ns.scene.gaussians import Gaussians

NEIGHBOURS = 8
"""Nearest merged Gaussians whose features are averaged."""

Inputs = Callable[[Piece], Callable[[Tensor, Gaussians], Tensor]]
"""From a piece, a function from features (K, F) and the scene before a step to all inputs of a
network, (K, F + E)."""


def no_inputs(piece: Piece) -> Callable[[Tensor, Gaussians], Tensor]:
    """Features of each Gaussian alone."""
    return lambda features, now: features


def neighbours(piece: Piece) -> Callable[[Tensor, Gaussians], Tensor]:
    """The mean of the features of the nearest Gaussians, too."""
    indices = nearest(piece.merged.means, NEIGHBOURS + 1)[1][:, 1:].to(piece.merged.device)
    return lambda features, now: torch.cat([features, features[indices].mean(1)], dim=1)


def members(piece: Piece) -> Callable[[Tensor, Gaussians], Tensor]:
    """Features of the dense Gaussians that each one stands for, too
    (:func:`~lab.feedback_pieces.member_features`)."""
    return lambda features, now: torch.cat([features, piece.members], dim=1)


INPUTS: dict[str, tuple[Inputs, int]] = {
    "own gradients": (no_inputs, 0),
    "and neighbours": (neighbours, FeedbackRefiner.FEATURES),
    "and members": (members, MEMBERS),
}
"""Inputs by name, and the number of columns that they add."""


def widened(start: FeedbackRefiner, more: int) -> FeedbackRefiner:
    """A network with ``more`` inputs that gives the factors of ``start`` before its training."""
    network = FeedbackRefiner(start.most_steps, inputs=FeedbackRefiner.FEATURES + more)
    state = dict(start.state_dict())
    first = torch.nn.functional.pad(state["mlp.0.weight"], (0, more))
    network.load_state_dict({**state, "mlp.0.weight": first})
    return network
