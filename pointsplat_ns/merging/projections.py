"""Projections of the remaining Gaussians along thirteen fixed directions, the axes and diagonals of a cube.

A pair is compared in three perpendicular projections: along the thinnest axis of its first member, and along two axes
across. These are rounded to the thirteen directions, so that a Gaussian is projected once for each direction, not once
for each of its pairs.

Lengths are in units of the size of the scene's content, and bounded such that float32 holds squares of products of
four of them.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.merging.covariance import plane_axes
from pointsplat_ns.merging.state import State
from pointsplat_ns.system.tensors import DOUBLES, INDICES

DIRECTIONS = torch.nn.functional.normalize(
    torch.tensor([way for way in itertools.product((-1.0, 0.0, 1.0), repeat=3) if way > (0, 0, 0)], **DOUBLES)
)
"""Unit vectors (13, 3)."""


@dataclass(frozen=True)
class ProjectionLimits:
    """Bounds of projections, in units of the content's size."""

    max_coordinate: float = 1e3
    """Bound of the absolute value of coordinates."""
    max_width: float = 1e3
    """Largest standard deviation."""
    min_width: float = 1e-6
    """Smallest standard deviation."""
    roundness: float = 1e-5
    """Variance that is added to a projection along both axes, as a share of its summed variances, so that float32 tells
    thin projections from lines: widths are at least 0.3 % of lengths."""
    min_divisor: float = 1e-30
    """Lower bound of float32 denominators, which keeps quotients finite; the smallest normal float32 is 1e-38."""
    max_growth: float = 100.0
    """Largest growth of the area by a replacement: points grow without bounds."""


PROJECTION_LIMITS = ProjectionLimits()


def _projection_matrices() -> tuple[Tensor, Tensor]:
    """For each direction the two axes of its plane, (13, 3, 2), and the matrix that turns the six numbers of a
    covariance into the three of its projection, (13, 6, 3)."""
    axes = torch.stack(plane_axes(DIRECTIONS), dim=2)
    u, v = axes[..., 0], axes[..., 1]

    def row(a: Tensor, b: Tensor) -> Tensor:
        x, y, z = a.unbind(1)
        p, q, r = b.unbind(1)
        return torch.stack([x * p, x * q + y * p, x * r + z * p, y * q, y * r + z * q, z * r], dim=1)

    return axes, torch.stack([row(u, u), row(u, v), row(v, v)], dim=2)


def _perpendicular_triples() -> Tensor:
    """Indices (13, 3) of each direction and of two more, as perpendicular to it and to each other as there are."""
    cosines = (DIRECTIONS @ DIRECTIONS.T).abs()
    rows = []
    for first in range(len(DIRECTIONS)):
        second = int(cosines[first].sort(stable=True).indices[0])
        third = int((cosines[first] + cosines[second]).sort(stable=True).indices[0])
        rows.append([first, second, third])
    return torch.tensor(rows, **INDICES)


PLANE_AXES, TO_PLANE = _projection_matrices()
TRIPLES = _perpendicular_triples()


def within_bounds(state: State, rows: Tensor) -> tuple[Tensor, Tensor]:
    """Means (m, 3) and covariances (m, 6) of some Gaussians in units of the content's size, around its centre, within
    the bounds, float64."""
    most = PROJECTION_LIMITS.max_coordinate
    means, cov = state.means[rows].double().clamp_(-most, most), state.cov[rows].double()
    total = cov[:, 0] + cov[:, 3] + cov[:, 5]
    cov *= (PROJECTION_LIMITS.max_width**2 / total.clamp_min(PROJECTION_LIMITS.max_width**2))[:, None]
    return means, cov


def directions_of(state: State, rows: Tensor) -> Tensor:
    """Indices (m, 3) of the directions in which some Gaussians are compared with their neighbours: that in which the
    projection is largest, and two across."""
    _, cov = within_bounds(state, rows)
    flat = (cov @ TO_PLANE.permute(1, 0, 2).reshape(6, -1)).view(-1, len(DIRECTIONS), 3)
    squared_areas = flat[..., 0] * flat[..., 2] - flat[..., 1] ** 2
    return TRIPLES[squared_areas.argmax(1)]


@dataclass(frozen=True, eq=False)
class Projections:
    """All Gaussians projected along one direction, in the precision of the costs."""

    table: Tensor  # [n, 8] centre u, v; variances uu, uv, vv; area; opacity; squared length of the colour
    colours: Tensor  # [n, C]

    @classmethod
    def empty(cls, state: State, dtype: torch.dtype) -> Projections:
        """The columns that do not depend on the direction; :meth:`fill` writes the others."""
        table, colours = torch.empty(len(state), 8, dtype=dtype, device="cpu"), state.colours.to(dtype)
        table[:, 6], table[:, 7] = state.alphas, colours.square().sum(1)
        return cls(table, colours)

    def fill(self, state: State, rows: Tensor, direction: int) -> None:
        """Project some Gaussians along a direction, by its index."""
        means, cov = within_bounds(state, rows)
        centres = (means @ PLANE_AXES[direction]).to(self.table)
        flat = (cov @ TO_PLANE[direction]).to(self.table)
        added = PROJECTION_LIMITS.roundness * (flat[:, 0] + flat[:, 2]) + PROJECTION_LIMITS.min_width**2
        flat[:, 0] += added
        flat[:, 2] += added
        self.table[rows, :6] = torch.cat([centres, flat, area_of(*flat.unbind(1))[:, None]], dim=1)


def area_of(uu: Tensor, uv: Tensor, vv: Tensor) -> Tensor:
    """Areas of projections with these covariances, in units of 2 pi: root of the determinant."""
    return (uu * vv).addcmul_(uv, uv, value=-1).clamp_min_(PROJECTION_LIMITS.min_divisor).sqrt_()
