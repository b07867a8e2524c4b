"""Quaternions (wxyz): rotation matrices, and the zero quaternion as the identity."""

from __future__ import annotations

import torch
from torch import Tensor

SHORTEST = torch.finfo(torch.float32).tiny
"""Smallest normal number of float32. A quaternion whose largest component is below it is taken for zero, in any
precision: float32 has no inverse of its length, so its direction would depend on the precision."""


def rotation_components(unit: Tensor) -> Tensor:
    """Rotation matrices (3, 3, M) of unit quaternions (4, M), each entry contiguous; zero gives the identity."""
    w, x, y, z = unit
    x2, y2, z2 = 2 * unit[1:]
    xx, yy, zz, xy, xz, yz = x * x2, y * y2, z * z2, x * y2, x * z2, y * z2
    wx, wy, wz = w * x2, w * y2, w * z2
    rows = [1 - (yy + zz), xy - wz, xz + wy, xy + wz, 1 - (xx + zz), yz - wx, xz - wy, yz + wx, 1 - (xx + yy)]
    return torch.stack(rows).view(3, 3, -1)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices of quaternions of any length.

    Args:
        quats: (N, 4) wxyz, finite; zero is the identity, and so are those shorter than :data:`SHORTEST`.

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

    The entries of a matrix are products of the components of q. They give 4 q q^T, of which the row with the largest
    diagonal is the best multiple of q (Shepperd 1978, Journal of Guidance and Control 1(3)).
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrices.double().unbind(-2))
    rows = [
        torch.stack([1 + a + e + i, h - f, c - g, d - b], dim=-1),
        torch.stack([h - f, 1 + a - e - i, b + d, c + g], dim=-1),
        torch.stack([c - g, b + d, 1 - a + e - i, f + h], dim=-1),
        torch.stack([d - b, c + g, f + h, 1 - a - e + i], dim=-1),
    ]
    products = torch.stack(rows, dim=-2)  # [..., 4, 4]
    best = products.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None].expand(*products.shape[:-2], 1, 4)
    return torch.nn.functional.normalize(products.gather(-2, best)[..., 0, :], dim=-1)


def zero_as_identity(quats: Tensor) -> Tensor:
    """Quaternions (N, 4), with the identity in place of each that is zero or shorter than :data:`SHORTEST`."""
    largest = quats.detach().abs().amax(dim=1, keepdim=True)
    # In float32, because half precision would round the bound to 0.
    return torch.where(largest.float() < SHORTEST, quats.new_tensor([1.0, 0.0, 0.0, 0.0]), quats)
