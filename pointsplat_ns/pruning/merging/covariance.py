"""Covariances of Gaussians, their projections onto planes and overlaps; batched, float64.

A symmetric 3 x 3 matrix is stored as six numbers (xx, xy, xz, yy, yz, zz), a symmetric 2 x 2 matrix
as three (uu, uv, vv). An image shows the projection of a Gaussian onto a plane. So sizes are areas,
not volumes, in units of 2 pi times squared scene units: the integral of a projection of peak 1 is
its area.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.kernels import (
    DOUBLE_POINTER,
    FLOAT_POINTER,
    INT64_POINTER,
    KERNELS,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.pieces import in_pieces
from pointsplat_ns.system.tensors import DOUBLES


class ShapesStruct(Struct):
    """``Shapes`` of ``covariance.cpp``, which documents its members."""

    members = {
        "log_scales": FLOAT_POINTER,
        "quats": FLOAT_POINTER,
        "rows": INT64_POINTER,
        "count": ctypes.c_int64,
        "cov": DOUBLE_POINTER,
    }
    _fields_ = c_fields(members)


covariances_kernel = Function("pointsplat_covariances", ShapesStruct, INT64_POINTER)

MIN_DIVISOR = 1e-300
"""Lower bound of float64 denominators, to keep quotients finite; the smallest normal float64 is
2e-308."""


def covariances(log_scales: Tensor, quats: Tensor) -> Tensor:
    """Covariances (N, 6), float64, of log-scales (N, 3), +-Inf allowed, and quaternions (N, 4)."""
    # products of four standard deviations and their squares fit into float64
    logs = log_scales.clamp(-40.0, 40.0)
    # an axis is at least exp(-11.5), 1e-5, of the longest, which float64 distinguishes from zero
    logs = torch.maximum(logs, logs.amax(dim=1, keepdim=True) - 11.5)
    axes = rotation_matrices(quats) * logs.exp()[:, None]
    return pack(axes @ axes.transpose(1, 2))


def covariances_of(scene: Gaussians, rows: Tensor, compiled: bool | None = None) -> Tensor:
    """:func:`covariances` (m, 6) of a scene's ``rows`` (m,); ``compiled`` False uses torch."""
    if not KERNELS.usable_for(compiled, scene.scales, scene.quats):
        return in_pieces(
            lambda some: covariances(scene.scales[some].double(), scene.quats[some].double()),
            rows,
            6,
        )
    cov = torch.empty(len(rows), 6, **DOUBLES)
    scales = scene.scales.contiguous()
    quats = scene.quats.contiguous()
    task = ShapesStruct(
        log_scales=scales, quats=quats, rows=rows.contiguous(), count=len(rows), cov=cov
    )
    on_threads(len(rows) >= SEVERAL, covariances_kernel, task)
    return cov


def pack(matrix: Tensor) -> Tensor:
    """(N, 6) of symmetric (N, 3, 3)."""
    a, b, c, _, d, e, _, _, f = matrix.reshape(-1, 9).unbind(1)
    return torch.stack([a, b, c, d, e, f], dim=1)


def unpack(six: Tensor) -> Tensor:
    """(N, 3, 3) of (N, 6)."""
    a, b, c, d, e, f = six.unbind(1)
    return torch.stack([a, b, c, b, d, e, c, e, f], dim=1).view(-1, 3, 3)


def diagonals(six: Tensor) -> Tensor:
    """Diagonals (N, 3) of (N, 6)."""
    return torch.stack([six[:, 0], six[:, 3], six[:, 5]], dim=1)


def widened(six: Tensor, variances: Tensor) -> Tensor:
    """Covariances (N, 6) plus variances (N,) in every direction."""
    return six + variances[:, None] * six.new_tensor([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])


def outer(vector: Tensor) -> Tensor:
    """(N, 6): vector times its transpose, of (N, 3)."""
    x, y, z = vector.unbind(1)
    return torch.stack([x * x, x * y, x * z, y * y, y * z, z * z], dim=1)


def eigen(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues (N, 3), ascending, and eigenvectors (N, 3, 3) in columns, of symmetric matrices
    (N, 3, 3) float64. On a CPU by LAPACK. On a GPU, where no library is made for many small
    matrices, by 6 sweeps of Jacobi rotations, which converge quadratically."""
    if matrices.device.type == "cpu":
        values, vectors = torch.linalg.eigh(matrices)
        return values, vectors
    unit = torch.eye(3, **DOUBLES).to(matrices.device)
    vectors = unit.expand_as(matrices)
    for p, q in 6 * ((0, 1), (0, 2), (1, 2)):
        angle = 0.5 * (
            2 * matrices[:, p, q] / (matrices[:, q, q] - matrices[:, p, p])
        ).atan().nan_to_num_(0.0)
        rotation = unit.repeat(len(matrices), 1, 1)
        rotation[:, p, p] = rotation[:, q, q] = angle.cos()
        rotation[:, p, q] = angle.sin()
        rotation[:, q, p] = -angle.sin()
        matrices = rotation.transpose(1, 2) @ matrices @ rotation
        vectors = vectors @ rotation
    values, order = matrices.diagonal(dim1=1, dim2=2).sort(dim=1)
    return values, vectors.gather(2, order[:, None].expand_as(vectors))


def inverses_and_log_determinants(matrices: Tensor) -> tuple[Tensor, Tensor]:
    """Inverses (N, 3, 3) and log-determinants (N,) of positive definite (N, 3, 3) float64."""
    if matrices.device.type == "cpu":
        return torch.linalg.inv(matrices), torch.logdet(matrices)
    values, vectors = eigen(matrices)
    return vectors / values[:, None] @ vectors.transpose(1, 2), values.log().sum(1)


def adjugate(six: Tensor) -> Tensor:
    """(N, 6): determinant times inverse. Its quadratic form with a unit vector is the squared area
    of the projection along that vector."""
    a, b, c, d, e, f = six.unbind(1)
    rows = [
        d * f - e * e,
        c * e - b * f,
        b * e - c * d,
        a * f - c * c,
        b * c - a * e,
        a * d - b * b,
    ]
    return torch.stack(rows, dim=1)


def bilinear(six: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """u^T M v, (N,), for matrices (N, 6) and vectors (N, 3)."""
    a, b, c, d, e, f = six.unbind(1)
    ux, uy, uz = u.unbind(1)
    vx, vy, vz = v.unbind(1)
    return (
        ux * (a * vx + b * vy + c * vz)
        + uy * (b * vx + d * vy + e * vz)
        + uz * (c * vx + e * vy + f * vz)
    )


def rms_area(six: Tensor) -> Tensor:
    """Root mean square, over all directions, of the projected area, (N,): the square root of a
    third of the sum of squared products of pairs of standard deviations."""
    sides = adjugate(six)
    return ((sides[:, 0] + sides[:, 3] + sides[:, 5]).clamp_min(0) / 3).sqrt()


def thinnest_axes(six: Tensor) -> Tensor:
    """Unit vectors (N, 3) near the axis of least variance; any axis if it is not unique.

    This axis is the dominant eigenvector of the adjugate. Squaring the matrix three times makes it
    dominate (power iteration).
    """
    matrix = adjugate(six)
    for _ in range(3):
        trace = (matrix[:, 0] + matrix[:, 3] + matrix[:, 5]).clamp_min(MIN_DIVISOR)
        a, b, c, d, e, f = (matrix / trace[:, None]).unbind(1)
        squared = [a * a + b * b + c * c, a * b + b * d + c * e, a * c + b * e + c * f]
        squared += [b * b + d * d + e * e, b * c + d * e + e * f, c * c + e * e + f * f]
        matrix = torch.stack(squared, dim=1)
    column = diagonals(matrix).argmax(1)
    vector = unpack(matrix)[torch.arange(len(matrix), device=six.device, dtype=torch.int64), column]
    length = vector.norm(dim=1, keepdim=True)
    return torch.where(
        length > MIN_DIVISOR,
        vector / length.clamp_min(MIN_DIVISOR),
        vector.new_tensor([0.0, 0.0, 1.0]),
    )


def plane_axes(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors (N, 3) that span the plane perpendicular to each unit normal (Duff et al.
    2017, JCGT 6(1))."""
    x, y, z = normal.unbind(1)
    sign = torch.where(z >= 0, torch.ones_like(z), -1.0)
    a = -1 / (sign + z)
    b = x * y * a
    return (
        torch.stack([1 + sign * x * x * a, sign * b, -sign * x], dim=1),
        torch.stack([b, sign + y * y * a, -y], dim=1),
    )


def projected(six: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Covariances (N, 3) of projections onto planes of unit vectors ``u`` and ``v`` (N, 3)."""
    return torch.stack([bilinear(six, u, u), bilinear(six, u, v), bilinear(six, v, v)], dim=1)


def projected_area(flat: Tensor) -> Tensor:
    """Areas (N,) of projections with covariances (N, 3): square root of the determinant."""
    return (flat[:, 0] * flat[:, 2] - flat[:, 1] ** 2).clamp_min(0).sqrt()


def overlap(first: Tensor, second: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Integral over the plane of the product of two projections of peak 1, (N,).

    The product of two Gaussians is a Gaussian. Its integral is the product of their areas, divided
    by the area of the summed covariance, times exp(-d^2 / 2) with d the Mahalanobis distance of the
    centres under that covariance. It is clamped to the smaller area, for projections like lines,
    where the area of the sum is lost to rounding.

    Args:
        first, second: (N, 3) covariances of the projections.
        u, v: (N,) each, from one centre to the other.
    """
    both = first + second
    area = projected_area(both).clamp_min(MIN_DIVISOR)
    distance = (both[:, 2] * u * u - 2 * both[:, 1] * u * v + both[:, 0] * v * v) / area / area
    large, small = (
        order(projected_area(first), projected_area(second))
        for order in (torch.maximum, torch.minimum)
    )
    return small * (large / area).clamp_max(1) * torch.exp(-0.5 * distance.clamp_min(0))
