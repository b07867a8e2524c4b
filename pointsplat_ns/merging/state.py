"""The Gaussians that remain after some rounds, in the numbers that a round needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.merging.covariance import covariances_of
from pointsplat_ns.merging.participants import Participants
from pointsplat_ns.merging.settings import MergeSettings
from pointsplat_ns.system.pieces import CHUNK, in_pieces
from pointsplat_ns.system.tensors import DOUBLES


def bounded(cov: Tensor) -> Tensor:
    """Covariances that float32 can hold."""
    return cov.clamp(-1e30, 1e30)


@dataclass(frozen=True, eq=False)
class State:
    """The Gaussians that remain after some rounds.

    Costs are of float32, and the shapes of groups are computed anew at the end, so that more digits would not show.
    """

    means: Tensor  # [n, 3] float32, around the centre, in units of the size
    cov: Tensor  # [n, 6] float32, in units of the squared size, see :func:`bounded`
    alphas: Tensor  # [n] float32
    colours: Tensor  # [n, C] float32 on principal axes, colour units
    weights: Tensor  # [n] float32, visibility weight per unit of area
    counts: Tensor  # [n] int32, number of Gaussians that each stands for
    centre: Tensor  # [3] float64, of the scene
    size: float
    """Diagonal of the scene's content, scene units."""

    def __len__(self) -> int:
        return len(self.means)

    def in_scene_units(self) -> tuple[Tensor, Tensor]:
        """Means (n, 3) and covariances (n, 6) in scene units, float64."""
        return self.means.double() * self.size + self.centre, self.cov.double() * self.size**2


class ColourAxes(NamedTuple):
    """Axes on which colours are compared."""

    middle: Tensor  # [3 (d+1)^2] float32, mean of the coefficients, colour units
    axes: Tensor  # [3 (d+1)^2, C] float32, orthogonal, each of length 1


def initial_state(
    participants: Participants,
    weights: Tensor,
    settings: MergeSettings,
    axes: ColourAxes | None = None,
    dtype: torch.dtype = torch.float32,
) -> State:
    """The state before the first round.

    Args:
        participants: n Gaussians of a scene.
        weights: (n,) visibility weight of each per unit of area.
        settings: ``colour_axes`` and ``max_colour``.
        axes: of the colours; by default the principal axes of the participants.
        dtype: float64 for a reference, which kernels do not take.
    """
    scene, members = participants.scene, participants.members
    centre, size = participants.centre.double(), participants.size
    return State(
        means=in_pieces(lambda rows: (scene.means[rows].double() - centre) / size, members, 3, dtype=dtype),
        cov=in_pieces(lambda rows: bounded(covariances_of(scene, rows) / size**2), members, 6, dtype=dtype),
        alphas=torch.sigmoid(scene.opacities[members, 0]).to(dtype),
        colours=_on_axes(scene, members, axes or principal_axes(scene, members, settings), settings),
        weights=weights.float(),
        counts=torch.ones(len(members), dtype=torch.int32, device="cpu"),
        centre=centre,
        size=size,
    )


def bounded_colours(coefficients: Tensor, settings: MergeSettings) -> Tensor:
    """SH coefficients in colour units, within ``max_colour``, float32."""
    return (coefficients.float() * SH_C0).clamp_(-settings.max_colour, settings.max_colour)


def _coefficients(scene: Gaussians, rows: Tensor, settings: MergeSettings) -> Tensor:
    """All SH coefficients (m, 3 (d+1)^2) of rows (m,), in colour units."""
    parts = scene.features_dc[rows], scene.features_rest[rows].reshape(len(rows), -1)
    return bounded_colours(torch.cat(parts, dim=1), settings)


def principal_axes(scene: Gaussians, members: Tensor, settings: MergeSettings) -> ColourAxes:
    """Principal axes of all SH coefficients of members (n,). By Parseval's theorem, the coefficients of every band
    contribute to the mean square over directions as the constant does."""
    pieces = members.split(CHUNK)
    width = 3 + 3 * scene.features_rest.shape[1]
    shift = _coefficients(scene, pieces[0], settings).mean(0)  # near the mean, so that float32 holds the squares
    total, products = torch.zeros(width, **DOUBLES), torch.zeros(width, width, **DOUBLES)
    for rows in pieces:
        values = _coefficients(scene, rows, settings) - shift
        total += values.sum(0)
        products += values.T @ values
    mean = total / len(members)
    covariance = products - len(members) * mean[:, None] * mean
    axes = torch.linalg.eigh(covariance).eigenvectors[:, -settings.colour_axes :].float()
    return ColourAxes((shift + mean).float(), axes)


def _on_axes(scene: Gaussians, members: Tensor, axes: ColourAxes, settings: MergeSettings) -> Tensor:
    """Colours (n, C) of members (n,) on axes, around their middle."""

    def on_axes(rows: Tensor) -> Tensor:
        return (_coefficients(scene, rows, settings) - axes.middle) @ axes.axes

    return in_pieces(on_axes, members, axes.axes.shape[1], dtype=torch.float32)
