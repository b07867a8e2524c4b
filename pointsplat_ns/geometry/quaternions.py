"""Quaternions (wxyz): rotation matrices, and the zero quaternion as the identity."""

from __future__ import annotations

import torch
from torch import Tensor


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
        quats: (N, 4) wxyz, finite; zero is the identity, and so are quaternions so short that their squares underflow.

    Returns:
        (N, 3, 3), of the same dtype.

    Example:
        >>> rotation_matrices(torch.tensor([[0.0, 0.0, 0.0, 2.0]])).tolist()  # half a turn about z
        [[[-1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]]]
    """
    length = quats.norm(dim=1, keepdim=True)
    unit = torch.where(length > 0, quats / length.clamp_min(torch.finfo(quats.dtype).tiny), identity_like(quats))
    return rotation_components(unit.T).permute(2, 0, 1)


def identity_like(quats: Tensor) -> Tensor:
    """The identity (4,) of the dtype and device of ``quats``."""
    return quats.new_tensor([1.0, 0.0, 0.0, 0.0])


def zero_as_identity(quats: Tensor) -> Tensor:
    """Quaternions (N, 4), with the identity in place of each zero one."""
    return torch.where((quats == 0).all(dim=1, keepdim=True), identity_like(quats), quats)
