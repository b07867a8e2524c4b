"""The Gaussians that remain while a scene is merged, and the replacement of pairs of them by one.

The replacement has the common mass (opacity times the area of the projection), centre, covariance and colour of both.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import SH_C0, Gaussians
from pointsplat_ns.pruning.covariance import (
    TINY,
    covariances,
    flat_area,
    flatten,
    normals,
    outer,
    overlap,
    plane,
    shadow,
)
from pointsplat_ns.system.pieces import CHUNK, in_pieces

OPAQUE = 0.99
"""Largest opacity of a replacement. If the mass needs more, the area grows."""

GROWTH = 0.6
"""The area grows with the ratio of needed opacity to :data:`OPAQUE`, to this power: 0 opens holes, 1 smears edges."""

MOST_SURPLUS = 4.0
"""Upper bound of that ratio. Two Gaussians seldom reach 2; for points without area it would be infinite."""

COLOUR_AXES = 8
"""Number of principal axes of the colours (all SH bands) used for costs; they hold nearly all of the variance."""

MOST_CONTRAST = 10.0
"""Bound of a colour's coefficients in costs, in colour units: a few broken colours must not hide all others."""


@dataclass
class State:
    """The Gaussians that remain after some rounds."""

    means: Tensor  # [n, 3] float64, scene units
    cov: Tensor  # [n, 6] float64, squared scene units
    alphas: Tensor  # [n] float64
    colours: Tensor  # [n, C] float32 on principal axes, colour units
    weights: Tensor  # [n] float32, how large a unit of area is to those who look
    members: Tensor  # [n] int32, number of Gaussians that each stands for
    centre: Tensor  # [3] float64, of the scene
    size: float
    """Diagonal of the scene's content, scene units."""

    def __len__(self) -> int:
        return len(self.means)

    def keep(self, mask: Tensor) -> None:
        """Drop those where ``mask`` (n,) is False."""
        for name in ("means", "cov", "alphas", "colours", "weights", "members"):
            setattr(self, name, getattr(self, name)[mask])

    def replace_pairs(self, first: Tensor, second: Tensor) -> Tensor:
        """Overwrite the first member of each pair (E,), (E,) by the pair's replacement.

        Returns:
            The share of the first in each pair's mass, (E,) float32.
        """
        shares = []
        for i, j in zip(first.split(CHUNK), second.split(CHUNK), strict=True):
            wi = self._replace(i, j)
            wj = 1 - wi
            for values in (self.colours, self.weights[:, None]):
                values[i] = wi.float()[:, None] * values[i] + wj.float()[:, None] * values[j]
            self.members[i] += self.members[j]
            shares.append(wi.float())
        return torch.cat(shares)

    def _replace(self, i: Tensor, j: Tensor) -> Tensor:
        ai, aj = self.alphas[i], self.alphas[j]
        mi, mj = ai * shadow(self.cov[i]), aj * shadow(self.cov[j])
        total = mi + mj
        wi = torch.where(total > TINY, mi / total.clamp_min(TINY), 0.5)
        wj = 1 - wi
        apart = self.means[i] - self.means[j]
        cov = wi[:, None] * self.cov[i] + wj[:, None] * self.cov[j] + (wi * wj)[:, None] * outer(apart)
        # The opacity is such that, seen along the thinnest axis, the mass is that of both less their overlap.
        axes = plane(normals(cov))
        si, sj, sk = (flatten(c, *axes) for c in (self.cov[i], self.cov[j], cov))
        u, v = ((apart * axis).sum(1) for axis in axes)
        mass = ai * flat_area(si) + aj * flat_area(sj) - ai * aj * overlap(si, sj, u, v)
        alphas = mass.clamp_min(0) / flat_area(sk).clamp_min(TINY)
        self.means[i] = wi[:, None] * self.means[i] + wj[:, None] * self.means[j]
        self.cov[i] = grown(cov, alphas)
        self.alphas[i] = alphas.clamp_max(OPAQUE)
        return wi


def covariances_of(scene: Gaussians, rows: Tensor) -> Tensor:
    """Covariances (m, 6) of some Gaussians, float64."""
    return covariances(scene.scales[rows].double(), scene.quats[rows].double())


def grown(cov: Tensor, alphas: Tensor) -> Tensor:
    """Covariances (n, 6) with the area that opacities (n,) above :data:`OPAQUE` need."""
    return cov * ((alphas / OPAQUE).clamp(1, MOST_SURPLUS) ** GROWTH)[:, None]


def start(scene: Gaussians, members: Tensor, weights: Tensor, centre: Tensor, size: float) -> State:
    """The state before the first round.

    Args:
        scene: N Gaussians on the CPU.
        members: (n,) indices of those that take part.
        weights: (n,) how large a unit of area is to those who look.
        centre: (3,) of the scene's content.
        size: diagonal of the scene's content, scene units.
    """
    return State(
        means=scene.means[members].double(),
        cov=in_pieces(lambda rows: covariances_of(scene, rows), members, 6),
        alphas=torch.sigmoid(scene.opacities[members, 0]).double(),
        colours=_colours(scene, members),
        weights=weights.float(),
        members=torch.ones(len(members), dtype=torch.int32),
        centre=centre.double(),
        size=size,
    )


def _colours(scene: Gaussians, members: Tensor) -> Tensor:
    """Colours (n, C) on the principal axes of all SH coefficients, around their mean. By Parseval, the coefficients of
    every band contribute to the mean square over directions as the constant does."""

    def coefficients(these: Tensor) -> Tensor:
        parts = scene.features_dc[these], scene.features_rest[these].reshape(len(these), -1)
        return (torch.cat(parts, dim=1).double() * SH_C0).clamp_(-MOST_CONTRAST, MOST_CONTRAST)

    width = 3 + 3 * scene.features_rest.shape[1]
    total, products = torch.zeros(width, dtype=torch.float64), torch.zeros(width, width, dtype=torch.float64)
    for these in members.split(CHUNK):
        values = coefficients(these)
        total += values.sum(0)
        products += values.T @ values
    mean = total / len(members)
    axes = torch.linalg.eigh(products - len(members) * mean[:, None] * mean).eigenvectors[:, -COLOUR_AXES:]
    return in_pieces(lambda rows: (coefficients(rows) - mean) @ axes, members, axes.shape[1], dtype=torch.float32)
