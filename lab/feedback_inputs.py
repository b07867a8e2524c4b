"""Further inputs of a feedback network, to measure what they bring: neighbours, and members."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from lab.feedback_pieces import MEMBERS, Piece
from pointsplat_ns.geometry.neighbours import nearest
from pointsplat_ns.refinement.feedback import FeedbackRefiner

NEIGHBOURS = 8
"""Nearest merged Gaussians whose features are averaged."""

Inputs = Callable[[Piece], Callable[[Tensor], Tensor]]
"""From a piece, a function from features (K, F) before a step to the inputs of a network, (K, F +
E)."""


def no_inputs(piece: Piece) -> Callable[[Tensor], Tensor]:
    """Features of each Gaussian alone."""
    return lambda features: features


def all_inputs(piece: Piece) -> Callable[[Tensor], Tensor]:
    """Features of each Gaussian; their mean over its nearest neighbours; features of the dense
    Gaussians that it stands for (:func:`~lab.feedback_pieces.member_features`). :data:`COLUMNS`
    says where."""
    around = nearest(piece.merged.means, NEIGHBOURS + 1)[1][:, 1:].to(piece.merged.device)
    return lambda features: torch.cat([features, features[around].mean(1), piece.members], dim=1)


_OWN = [*range(FeedbackRefiner.FEATURES)]
_NEIGHBOURS = [len(_OWN) + column for column in _OWN]
_MEMBERS = [2 * len(_OWN) + column for column in range(MEMBERS)]

COLUMNS: dict[str, list[int]] = {
    "own": _OWN,
    "own and neighbours": _OWN + _NEIGHBOURS,
    "own and members": _OWN + _MEMBERS,
}
"""Columns of :func:`all_inputs` that a network may see, by name."""
