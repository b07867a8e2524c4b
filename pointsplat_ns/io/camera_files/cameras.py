"""The cameras of a file, checked and made views of one size."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.cameras import invert_rigid
from pointsplat_ns.views import Views

MOST_CAMERAS = 100_000
MOST_PIXELS = 100_000
"""Maximum of a photo's width and height."""

_RIGID = 1e-3
"""Largest deviation of a rotation; text of four digits has less."""

_FARTHEST = 1e9
"""Largest coordinate of a camera: squares of it are numbers in float32."""


class Camera(NamedTuple):
    """One camera as a file has it, unchecked."""

    name: str
    """Of its photo; empty if the file has none."""
    pose: Sequence[float]
    """16 numbers of the 4 x 4 matrix from camera to world, row by row; OpenCV axes (x right, y down, z forward)."""
    size: tuple[float, float]
    """Width and height, pixels."""
    focal: tuple[float, float]
    """fx and fy, pixels."""
    centre: tuple[float, float]
    """Principal point, pixels, the first pixel's centre at (0.5, 0.5)."""


@dataclass(frozen=True)
class Motion:
    """A rigid transform of a world, and then a scale, as nerfstudio applies them to a dataset."""

    transform: Tensor  # [3, 4] float64, rigid
    scale: float = 1.0
    """Of positions, after the transform."""

    def of(self, poses: Tensor) -> Tensor:
        """Poses (C, 4, 4) from camera to world, moved."""
        moved = poses.clone()
        moved[:, :3] = self.transform[:, :3] @ poses[:, :3]
        moved[:, :3, 3] = (moved[:, :3, 3] + self.transform[:, 3]) * self.scale
        return moved

    def undone_before(self, other: Motion) -> Motion:
        """The motion that undoes this one and then does ``other``, as nerfstudio composes them: scales apart from
        transforms."""
        back = invert_rigid(self.transform[None])[0]
        last = other.transform.new_tensor([[0.0, 0.0, 0.0, 1.0]])
        return Motion((torch.cat([other.transform, last]) @ back)[:3], other.scale / self.scale)


@dataclass(frozen=True)
class CameraFile:
    """Content of a camera file."""

    cameras: Sequence[Camera]
    saved: Motion | None = None
    """The motion that was applied to the original world before the file was saved; None if the file's world is no
    dataset's, so that no ``dataparser_transforms.json`` is about it."""


def finite(value: Any) -> float | None:
    """A finite number of JSON; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def rigid(values: Tensor, whose: str) -> Tensor:
    """Poses or transforms (C, 3 or 4, 4) float64 whose rotations are exactly that, rounding taken out.

    Args:
        values: as they were read.
        whose: text that an error begins with; ``{}`` in it stands for the index of the first wrong one.

    Raises:
        DataError: if a number is not finite, or a matrix is no rigid motion.
    """
    turn = values[:, :3, :3]
    off = (turn @ turn.transpose(1, 2) - torch.eye(3, dtype=values.dtype)).abs().amax((1, 2))
    good = values.isfinite().all(2).all(1) & (off <= _RIGID) & (torch.linalg.det(turn) > 0)  # NaN fails too
    if values.shape[1] == 4:
        good &= ((values[:, 3] - values.new_tensor([0.0, 0.0, 0.0, 1.0])).abs() <= _RIGID).all(1)
    if not bool(good.all()):
        index = int((~good).nonzero()[0])
        raise DataError(
            f"{whose.format(index)} is no rigid motion; expected a rotation (no scale, no mirror) and a position, all "
            "finite; correct it or leave it out"
        )
    u, _, vh = torch.linalg.svd(turn)
    exact = values.clone()
    exact[:, :3, :3] = u @ vh
    return exact


def views_of(path: Path, cameras: Sequence[Camera], motion: Motion | None = None) -> Views:
    """Cameras as views over black, sorted by the names of their photos, r_2 before r_10.

    Views have one size. Cameras of another size than the most common one see the same field of view at that size: their
    intrinsics are stretched, width and height each by itself.

    Args:
        path: of the file, for errors.
        cameras: what it has.
        motion: what moves its world to the scene's.

    Returns:
        C views, float64 on the CPU.

    Raises:
        DataError: if there is no camera, there are too many, or one is none; the text has its index in the file.
    """
    need_count(path, len(cameras))
    poses = rigid(
        torch.tensor([camera.pose for camera in cameras], dtype=torch.float64).view(-1, 4, 4),
        f"{path}: the pose of camera {{}}",
    )
    if motion is not None:
        poses = motion.of(poses)
    sizes, focals, centres = (
        torch.tensor([camera[field] for camera in cameras], dtype=torch.float64).view(-1, 2) for field in (2, 3, 4)
    )
    _need(path, cameras, poses[:, :3, 3].abs().amax(1) <= _FARTHEST, "is too far away", f"at most {_FARTHEST:g} units")
    whole = (sizes == sizes.floor()) & (sizes >= 1) & (sizes <= MOST_PIXELS)
    _need(path, cameras, whole.all(1), "has a picture of no usable size", f"1 to {MOST_PIXELS} pixels a side")
    long = (focals >= 1e-3 * sizes) & (focals <= 1e5 * sizes)  # fields of view of 179.9 and 0.0006 degrees
    _need(path, cameras, long.all(1), "has no usable focal length", "a positive number of pixels")
    # Principal points at most 100 sides of the picture away from its corner.
    near = (centres.abs() <= 100.0 * sizes).all(1)
    _need(path, cameras, near, "has its principal point far outside of the picture", "one in or near it")
    counts = Counter((int(width), int(height)) for width, height in sizes.tolist())
    width, height = max(counts, key=lambda size: (counts[size], size[0] * size[1]))
    stretch = sizes.new_tensor([width, height]) / sizes
    Ks = torch.eye(3, dtype=torch.float64).repeat(len(cameras), 1, 1)
    Ks[:, [0, 1], [0, 1]], Ks[:, :2, 2] = focals * stretch, centres * stretch
    order = list(range(len(cameras)))
    if all(camera.name for camera in cameras):
        order.sort(key=lambda index: _in_order(cameras[index].name))
    return Views(invert_rigid(poses)[order], Ks[order], width, height, torch.zeros(3))


def need_count(path: Path, count: int) -> None:
    """Refuse a file of no camera, or of too many.

    Raises:
        DataError: if it is one.
    """
    if not 0 < count <= MOST_CAMERAS:
        raise DataError(f"{path}: {count} cameras; expected 1 to {MOST_CAMERAS}")


def _need(path: Path, cameras: Sequence[Camera], good: Tensor, what: str, expected: str) -> None:
    """Refuse cameras that are not ``good`` (C,); the error names the first."""
    if bool(good.all()):
        return
    index = int((~good).nonzero()[0])
    name = f" ({cameras[index].name[:60]})" if cameras[index].name else ""
    raise DataError(f"{path}: camera {index}{name} {what}; expected {expected}; correct it or leave it out")


def _in_order(name: str) -> str:
    """A key to sort names by that takes digits for numbers."""
    return re.sub(r"\d+", lambda digits: digits[0].zfill(20), name)
