"""Covariances of Gaussians, their projections onto planes, and the overlaps of these, in batches.

A symmetric 3 x 3 matrix is stored as its six numbers (xx, xy, xz, yy, yz, zz). What is seen of a Gaussian is its
projection onto a plane, here called its shadow. So sizes are areas, not volumes, in units of 2 pi times squared scene
units.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.geometry.quaternions import rotation_matrices

TINY = 1e-300
"""Lower bound of denominators, which keeps quotients finite; the smallest normal float64 is 2e-308."""

LOG_SCALE_LIMIT = 40.0
"""Log-scales are clamped to +-this: products of four standard deviations and their squares stay in float64."""

THINNEST = 11.5
"""Axes shorter than exp(-this) (1e-5) of the longest are set to that length, which float64 still tells from zero."""


def covariances(log_scales: Tensor, quats: Tensor) -> Tensor:
    """Covariances (N, 6) of Gaussians with log-scales (N, 3), +-Inf allowed, and quaternions (N, 4), float64."""
    logs = log_scales.clamp(-LOG_SCALE_LIMIT, LOG_SCALE_LIMIT)
    logs = torch.maximum(logs, logs.amax(dim=1, keepdim=True) - THINNEST)
    axes = rotation_matrices(quats) * logs.exp()[:, None]
    return pack(axes @ axes.transpose(1, 2))


def pack(matrix: Tensor) -> Tensor:
    """(N, 6) of symmetric (N, 3, 3)."""
    return matrix.reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]


def unpack(six: Tensor) -> Tensor:
    """(N, 3, 3) of (N, 6)."""
    return six[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]].view(-1, 3, 3)


def outer(vector: Tensor) -> Tensor:
    """(N, 6): vector times its transpose, of (N, 3)."""
    x, y, z = vector.unbind(1)
    return torch.stack([x * x, x * y, x * z, y * y, y * z, z * z], dim=1)


def adjugate(six: Tensor) -> Tensor:
    """(N, 6): determinant times inverse. Along a unit vector it gives the squared area of the shadow cast that way."""
    a, b, c, d, e, f = six.unbind(1)
    rows = [d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b]
    return torch.stack(rows, dim=1)


def form(six: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """u^T M v, (N,)."""
    a, b, c, d, e, f = six.unbind(1)
    ux, uy, uz = u.unbind(1)
    vx, vy, vz = v.unbind(1)
    return ux * (a * vx + b * vy + c * vz) + uy * (b * vx + d * vy + e * vz) + uz * (c * vx + e * vy + f * vz)


def shadow(six: Tensor) -> Tensor:
    """Area of the shadow, as root mean square over all directions, (N,): the square root of a third of the sum of the
    squared products of each two standard deviations."""
    sides = adjugate(six)
    return ((sides[:, 0] + sides[:, 3] + sides[:, 5]).clamp_min(0) / 3).sqrt()


def normals(six: Tensor) -> Tensor:
    """Unit vectors (N, 3) near the thinnest axis; any axis if there is no thinnest one.

    The thinnest axis is the dominant eigenvector of the adjugate. Squaring the matrix three times makes it dominate
    (power iteration).
    """
    matrix = unpack(adjugate(six))
    for _ in range(3):
        matrix = matrix / matrix.diagonal(dim1=1, dim2=2).sum(1).clamp_min(TINY)[:, None, None]
        matrix = matrix @ matrix
    column = matrix.diagonal(dim1=1, dim2=2).argmax(1)
    vector = matrix[torch.arange(len(matrix), device=six.device), column]
    length = vector.norm(dim=1, keepdim=True)
    return torch.where(length > TINY, vector / length.clamp_min(TINY), vector.new_tensor([0.0, 0.0, 1.0]))


def plane(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (N, 3) that span the plane perpendicular to each unit normal (Duff et al. 2017, JCGT 6(1))."""
    x, y, z = normal.unbind(1)
    sign = torch.where(z >= 0, 1.0, -1.0).to(normal)
    a = -1 / (sign + z)
    b = x * y * a
    return (
        torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=1),
        torch.stack([b, sign + y * y * a, -y], dim=1),
    )


def flatten(six: Tensor, first: Tensor, second: Tensor) -> Tensor:
    """Covariances (N, 3) = (uu, uv, vv) of the shadows on the plane of ``first`` and ``second``."""
    return torch.stack([form(six, first, first), form(six, first, second), form(six, second, second)], dim=1)


def flat_area(flat: Tensor) -> Tensor:
    """Areas (N,) of shadows (N, 3): root of the determinant."""
    return (flat[:, 0] * flat[:, 2] - flat[:, 1] ** 2).clamp_min(0).sqrt()


def overlap(first: Tensor, second: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Integral over the plane of the product of two shadows of peak 1 whose centres are (u, v) apart, (N,).

    The product of two Gaussians is a Gaussian. Its integral is the product of their areas, divided by the area of the
    summed covariance, times exp(-d^2 / 2) with d the Mahalanobis distance of the centres under that covariance. It is
    no larger than the smaller area, also where the area of the sum, of shadows like lines, is lost to rounding.
    """
    both = first + second
    area = flat_area(both).clamp_min(TINY)
    distance = (both[:, 2] * u * u - 2 * both[:, 1] * u * v + both[:, 0] * v * v) / area / area
    large, small = (order(flat_area(first), flat_area(second)) for order in (torch.maximum, torch.minimum))
    return small * (large / area).clamp_max(1) * torch.exp(-0.5 * distance.clamp_min(0))
