"""Rotates, mirrors, scales and moves scenes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.geometry.harmonics import sh_matrix
from pointsplat_ns.geometry.transforms import (
    direction_of,
    named_direction,
    quaternions_of,
    zero_as_identity,
)
from pointsplat_ns.scene.gaussians import Gaussians, Offset
from pointsplat_ns.system.tensors import DOUBLES


def turned(scene: Gaussians, matrix: Tensor, quat: Tensor | None = None) -> Gaussians:
    """Rotate positions, Gaussians, SH and the declared up direction about the origin.

    Args:
        scene: N Gaussians.
        matrix: (3, 3) float64, orthogonal, applied to positions. A determinant of -1 mirrors. A
            reflection through the origin leaves covariances, and so the rotations of Gaussians,
            unchanged.
        quat: (4,) wxyz, unit: the rotation part of the matrix, by default computed. Its sign
            determines the sign of the quaternions.
    """
    from kornia.geometry.quaternion import Quaternion

    like = scene.means
    rest = []
    first = 0
    for degree in range(1, scene.sh_degree + 1):
        size = 2 * degree + 1
        band = scene.features_rest[:, first : first + size]
        rest.append(torch.einsum("ij,njc->nic", sh_matrix(matrix, degree).to(like), band))
        first += size
    if quat is None:
        quat = quaternions_of(matrix * torch.linalg.det(matrix).sign())
    turn = Quaternion(quat.to(like).expand(len(scene), 4))
    return scene.replace(
        means=scene.means @ matrix.T.to(like),
        quats=(turn * Quaternion(zero_as_identity(scene.quats))).data,
        features_rest=torch.cat(rest, dim=1) if rest else scene.features_rest,
        up=None if scene.up is None else named_direction(matrix @ direction_of(scene.up)),
        offset=_times(scene.offset, matrix),
    )


def _times(offset: Offset | None, matrix: Tensor) -> Offset | None:
    """An offset after a linear map (3, 3), float64."""
    if offset is None:
        return None
    x, y, z = (matrix @ torch.tensor(offset, **DOUBLES)).tolist()
    return x, y, z


@dataclass(frozen=True, eq=False)
class Similarity:
    """Rotates, scales and moves a scene: a point x becomes ``scale * matrix @ x + offset``."""

    matrix: Tensor  # [3, 3] float64, orthogonal; a determinant of -1 mirrors
    scale: float  # above 0
    offset: Tensor  # [3] float64

    def inverse(self) -> Similarity:
        """The inverse similarity."""
        return Similarity(
            self.matrix.T, 1 / self.scale, -(self.matrix.T @ self.offset) / self.scale
        )

    def apply(self, scene: Gaussians) -> Gaussians:
        """The scene after the transform; SH are rotated or mirrored with it."""
        moved = turned(scene.to(dtype=torch.float64), self.matrix)
        return moved.replace(
            means=moved.means * self.scale + self.offset.to(moved.means),
            scales=moved.scales + math.log(self.scale),
            offset=_times(moved.offset, self.scale * torch.eye(3, **DOUBLES)),
        ).to(dtype=scene.dtype)
