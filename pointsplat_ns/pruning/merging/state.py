"""The Gaussians that remain after some rounds, in the numbers that a round needs."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.pruning.merging.covariance import covariances_of
from pointsplat_ns.pruning.merging.participants import Participants
from pointsplat_ns.pruning.merging.settings import MergeSettings
from pointsplat_ns.system.pieces import CHUNK, in_pieces


@dataclass(frozen=True, eq=False)
class State:
    """The Gaussians that remain after some rounds."""

    means: Tensor  # [n, 3] float64, scene units
    cov: Tensor  # [n, 6] float64, squared scene units
    alphas: Tensor  # [n] float64
    colours: Tensor  # [n, C] float32 on principal axes, colour units
    weights: Tensor  # [n] float32, visibility weight per unit of area
    counts: Tensor  # [n] int32, number of Gaussians that each stands for
    centre: Tensor  # [3] float64, of the scene
    size: float
    """Diagonal of the scene's content, scene units."""

    def __len__(self) -> int:
        return len(self.means)


def initial_state(participants: Participants, weights: Tensor, settings: MergeSettings) -> State:
    """The state before the first round.

    Args:
        participants: n Gaussians of a scene.
        weights: (n,) visibility weight of each per unit of area.
        settings: ``colour_axes`` and ``max_colour``.
    """
    scene, members = participants.scene, participants.members
    return State(
        means=scene.means[members].double(),
        cov=in_pieces(lambda rows: covariances_of(scene, rows), members, 6),
        alphas=torch.sigmoid(scene.opacities[members, 0]).double(),
        colours=_principal_colours(scene, members, settings),
        weights=weights.float(),
        counts=torch.ones(len(members), dtype=torch.int32),
        centre=participants.centre.double(),
        size=participants.size,
    )


def bounded_colours(coefficients: Tensor, settings: MergeSettings) -> Tensor:
    """SH coefficients in colour units, within ``max_colour``, float32."""
    return (coefficients.float() * SH_C0).clamp_(-settings.max_colour, settings.max_colour)


def _principal_colours(scene: Gaussians, members: Tensor, settings: MergeSettings) -> Tensor:
    """Colours (n, C) on the principal axes of all SH coefficients, around their mean. By Parseval's theorem, the
    coefficients of every band contribute to the mean square over directions as the constant does."""

    def coefficients(rows: Tensor) -> Tensor:
        parts = scene.features_dc[rows], scene.features_rest[rows].reshape(len(rows), -1)
        return bounded_colours(torch.cat(parts, dim=1), settings)

    pieces = members.split(CHUNK)
    width = 3 + 3 * scene.features_rest.shape[1]
    shift = coefficients(pieces[0]).mean(0)  # near the mean, so that float32 holds the squares
    total, products = torch.zeros(width, dtype=torch.float64), torch.zeros(width, width, dtype=torch.float64)
    for rows in pieces:
        values = coefficients(rows) - shift
        total += values.sum(0)
        products += values.T @ values
    mean = total / len(members)
    covariance = products - len(members) * mean[:, None] * mean
    axes = torch.linalg.eigh(covariance).eigenvectors[:, -settings.colour_axes :].float()
    middle = (shift + mean).float()
    return in_pieces(lambda rows: (coefficients(rows) - middle) @ axes, members, axes.shape[1], dtype=torch.float32)
