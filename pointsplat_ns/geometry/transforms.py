"""Rotations, camera poses and space-filling curves.

gsplat, COLMAP and the Replica files use OpenCV camera axes (x right, y down, z forward); nerfstudio
uses OpenGL axes (x right, y up, z back).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import DOUBLES

AXES = ("x", "y", "z", "-x", "-y", "-z")
"""Names of the directions along the world axes."""


Direction = tuple[float, float, float]
"""A direction by three numbers, of any length but 0."""


def direction_of(axis: str | Direction) -> Tensor:
    """The unit direction (3,), float64, of a name in :data:`AXES` or of three numbers."""
    if not isinstance(axis, str):
        numbers = torch.tensor(axis, **DOUBLES)
        return numbers / numbers.norm()
    direction = torch.zeros(3, **DOUBLES)
    direction["xyz".index(axis[-1])] = -1.0 if axis[0] == "-" else 1.0
    return direction


def axis_along(direction: Tensor) -> str | None:
    """Name of the axis along a unit direction (3,), up to rounding; None if there is none."""
    axis = int(direction.abs().argmax())
    if float(direction.abs()[axis]) <= 1 - 1e-6:
        return None
    return ("-" if float(direction[axis]) < 0 else "") + "xyz"[axis]


def named_direction(direction: Tensor) -> str | Direction:
    """A unit direction (3,) by the name of its axis, or by its numbers if it is along none."""
    x, y, z = direction.tolist()
    return axis_along(direction) or (x, y, z)


def flip_camera_axes(camera_to_worlds: Tensor) -> Tensor:
    """Convert camera-to-world matrices (..., 3 or 4, 4) between OpenGL and OpenCV axes, in either
    direction: the second and third columns change sign."""
    return camera_to_worlds * camera_to_worlds.new_tensor([1.0, -1.0, -1.0, 1.0])


def invert_rigid(matrices: Tensor) -> Tensor:
    """Inverses (C, 4, 4) of rigid motions (C, 3 or 4, 4), by transposing R. Differentiable."""
    rotation = matrices[:, :3, :3].transpose(1, 2)
    translation = -rotation @ matrices[:, :3, 3:]
    last_row = matrices.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(matrices), 1, 4)
    return torch.cat([torch.cat([rotation, translation], dim=2), last_row], dim=1)


def camera_positions(viewmats: Tensor) -> Tensor:
    """Positions (C, 3) of the cameras of world-to-camera matrices (C, 4, 4). Differentiable."""
    return invert_rigid(viewmats)[:, :3, 3]


def viewmats_from_opengl(camera_to_worlds: Tensor) -> Tensor:
    """World-to-camera matrices (C, 4, 4) with OpenCV axes, for rasterizers, from nerfstudio's
    camera-to-world matrices (C, 3, 4) with OpenGL axes. Differentiable."""
    return invert_rigid(flip_camera_axes(camera_to_worlds))


def viewmats_to_opengl(viewmats: Tensor) -> Tensor:
    """The inverse of :func:`viewmats_from_opengl`: (C, 4, 4) to (C, 3, 4)."""
    return flip_camera_axes(invert_rigid(viewmats))[:, :3]


SHORTEST = torch.finfo(torch.float32).tiny
"""Smallest normal number of float32. A quaternion whose largest component is below it counts as
zero, in any precision: the inverse of its length overflows float32, so its direction would depend
on the precision."""


def unit_rows(vectors: Tensor) -> tuple[Tensor, Tensor]:
    """Unit vectors (D, M) of the columns of (D, M), and the inverse of their lengths (M).

    A zero vector, or one shorter than :data:`SHORTEST`, becomes zero, and so does its inverse
    length: it has no gradient. The length is computed after division by the largest component, so
    that neither 1e-30 nor 1e30 under- or overflows.
    """
    largest = vectors.abs().amax(dim=0)
    zero = largest < SHORTEST
    inverse = largest.masked_fill(zero, torch.inf).reciprocal_()
    scaled = vectors * inverse
    length = (scaled * scaled).sum(dim=0).masked_fill_(zero, 1.0).rsqrt_()
    return scaled.mul_(length), inverse.mul_(length)


def rotation_components(unit: Tensor) -> Tensor:
    """Rotation matrices (3, 3, M) of unit quaternions (4, M), by entry; zero is the identity."""
    w, x, y, z = unit
    x2, y2, z2 = 2 * unit[1:]
    xx = x * x2
    yy = y * y2
    zz = z * z2
    xy = x * y2
    xz = x * z2
    yz = y * z2
    wx = w * x2
    wy = w * y2
    wz = w * z2
    rows = [
        1 - (yy + zz),
        xy - wz,
        xz + wy,
        xy + wz,
        1 - (xx + zz),
        yz - wx,
        xz - wy,
        yz + wx,
        1 - (xx + yy),
    ]
    return torch.stack(rows).view(3, 3, -1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions of any length.

    Args:
        quats: (N, 4) wxyz, finite; zero, or shorter than :data:`SHORTEST`, is the identity.

    Returns:
        (N, 3, 3), of the same dtype.

    Example:
        >>> rotation_matrices(torch.tensor([[0.0, 0.0, 0.0, 2.0]])).tolist()  # half a turn about z
        [[[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]]
    """
    wide = zero_as_identity(quats).double()  # squares of 1e-30 underflow in float32
    unit = (wide / wide.norm(dim=1, keepdim=True)).to(quats.dtype)
    return rotation_components(unit.T).permute(2, 0, 1)


def quaternions_of(matrices: Tensor) -> Tensor:
    """Quaternions (..., 4) wxyz, float64, of rotation matrices (..., 3, 3).

    The entries of a matrix are products of the components of q. They give 4 q q^T. Its row with the
    largest diagonal entry is the most accurate multiple of q (Shepperd 1978, Journal of Guidance
    and Control 1(3)).
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrices.double().unbind(-2))
    rows = [
        torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
        torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
        torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
        torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
    ]
    products = torch.stack(rows, dim=-2)  # [..., 4, 4]
    best = (
        products.diagonal(dim1=-2, dim2=-1)
        .argmax(-1)[..., None, None]
        .expand(*products.shape[:-2], 1, 4)
    )
    return torch.nn.functional.normalize(products.gather(-2, best)[..., 0, :], dim=-1)


def zero_as_identity(quats: Tensor) -> Tensor:
    """Quaternions (N, 4), with the identity for those that are zero or shorter than
    :data:`SHORTEST`."""
    largest = quats.detach().abs().amax(dim=1, keepdim=True)
    # In float32, because half precision would round the bound to 0.
    return torch.where(largest.float() < SHORTEST, quats.new_tensor([1.0, 0.0, 0.0, 0.0]), quats)


def spread_bits(x: Tensor) -> Tensor:
    """Move bit k of every integer to bit 3k, for k below 21, in five steps of halving distance.

    Args:
        x: int64 of any shape; bits from 21 on are dropped.
    """
    x = x & 0x1FFFFF
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        x |= x << shift
        x &= mask
    return x


def interleave(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Morton code of three coordinates with spread bits; x has the highest bit."""
    return (x << 2).bitwise_or_(y << 1).bitwise_or_(z)


class Cube(NamedTuple):
    """A cube in space."""

    centre: Tensor  # [3] float64
    side: Tensor  # scalar, float64, above 0


def bulk_cube(means: Tensor) -> Cube:
    """The cube around the bulk of positions (N, 3), twice as wide as 98 % of them along the widest
    axis, so that a few distant Gaussians do not coarsen the grid of the others."""
    some = means[:: max(1, len(means) // 2**14)].double()
    n = len(some)
    ranked = some.sort(dim=0).values
    low = ranked[(n - 1) // 100]
    high = ranked[n - 1 - (n - 1) // 100]
    side = 2 * (high - low).amax()
    return Cube(0.5 * (low + high), side.clamp_min(torch.finfo(torch.float64).tiny))


def unit_cells(means: Tensor, cube: Cube | None = None) -> Tensor:
    """Positions (N, 3), float32, relative to a cube that becomes the unit cube, by default
    :func:`bulk_cube`; clamped to [0, 1]."""
    cube = cube or bulk_cube(means)
    return (means.double() - cube.centre).div_(cube.side).float().clamp_(-0.5, 0.5).add_(0.5)


def curve_keys(cells: Tensor, offset: float = 0.0) -> Tensor:
    """Morton codes (N,) int64 of points (N, 3) in the unit cube, shifted by ``offset``."""
    grid = (cells.T + offset).clamp_(0, 1).mul_(2**20 - 1).long()  # 60 of the 63 bits in a key
    return interleave(*(spread_bits(axis) for axis in grid))


def smallest_turn(start: Tensor, end: Tensor) -> Tensor:
    """The smallest rotation (3, 3) between two directions; not unique for opposite ones."""
    cosine = float(start @ end)
    if cosine < -1 + 1e-12:
        side = torch.linalg.cross(start, torch.eye(3, **DOUBLES)[int(start.abs().argmin())])
        side = side / side.norm()
        return 2 * side[:, None] * side[None] - torch.eye(3, **DOUBLES)
    cross = torch.linalg.cross(start, end)
    x, y, z = cross.tolist()
    skew = torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], **DOUBLES)
    return torch.eye(3, **DOUBLES) + skew + skew @ skew / (1 + cosine)
