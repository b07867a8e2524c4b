"""Camera poses: the two conventions of axes in use, and the inverse of a rigid motion.

gsplat, COLMAP and the Replica files have OpenCV's axes (x right, y down, z forward); nerfstudio has OpenGL's (x right,
y up, z back).
"""

from __future__ import annotations

import torch
from torch import Tensor


def flip_camera_axes(camera_to_worlds: Tensor) -> Tensor:
    """Camera-to-world matrices (..., 3 or 4, 4) with OpenGL axes from OpenCV ones, or the other way round: the second
    and third columns change their sign."""
    return camera_to_worlds * camera_to_worlds.new_tensor([1.0, -1.0, -1.0, 1.0])


def invert_rigid(matrices: Tensor) -> Tensor:
    """Inverses (C, 4, 4) of rigid motions (C, 3 or 4, 4): the rotation's inverse is its transpose. Differentiable."""
    rotation = matrices[:, :3, :3].transpose(1, 2)
    translation = -rotation @ matrices[:, :3, 3:]
    last_row = matrices.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(matrices), 1, 4)
    return torch.cat([torch.cat([rotation, translation], dim=2), last_row], dim=1)


def viewmats_from_opengl(camera_to_worlds: Tensor) -> Tensor:
    """World-to-camera matrices with OpenCV axes (C, 4, 4), as rasterizers take them, from nerfstudio's camera-to-world
    (C, 3, 4), which have OpenGL axes. Differentiable."""
    return invert_rigid(flip_camera_axes(camera_to_worlds))


def viewmats_to_opengl(viewmats: Tensor) -> Tensor:
    """The inverse of :func:`viewmats_from_opengl`: (C, 4, 4) to (C, 3, 4)."""
    return flip_camera_axes(invert_rigid(viewmats))[:, :3]
