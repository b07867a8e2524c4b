"""Checks the cameras of a file and converts them to views."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.scene.views import ImageSize, Views
from pointsplat_ns.system.tensors import DOUBLES, FLOATS

MOST_CAMERAS = 100_000
"""Maximum number of cameras in a file."""


class Camera(NamedTuple):
    """One camera as read from a file, unchecked."""

    name: str
    """Name of its photo; empty if the file has none."""
    pose: Sequence[float]
    """Camera-to-world matrix, 16 numbers, row-major; OpenCV axes (x right, y down, z forward)."""
    size: tuple[float, float]
    """Width and height, pixels."""
    focal: tuple[float, float]
    """fx and fy, pixels."""
    centre: tuple[float, float]
    """Principal point, pixels; the centre of the first pixel is (0.5, 0.5)."""
    model: str = "PINHOLE"
    """COLMAP name of the camera model."""
    distortion: tuple[float, ...] = ()
    """Distortion parameters, in COLMAP's order."""
    mask: str = ""
    """File name of the mask of valid pixels; empty if all are valid."""

    @property
    def bent(self) -> bool:
        """Whether the lens has distortion."""
        return "FISHEYE" in self.model or "k4" in self.model or any(self.distortion)


@dataclass(frozen=True)
class Motion:
    """A rigid transform of a world followed by a scale, as nerfstudio applies them to a dataset."""

    transform: Tensor  # [3, 4] float64, rigid
    scale: float = 1.0
    """Scale of positions, applied after the transform."""

    def of(self, poses: Tensor) -> Tensor:
        """Camera-to-world poses (C, 4, 4) after this motion."""
        moved = poses.clone()
        moved[:, :3] = self.transform[:, :3] @ poses[:, :3]
        moved[:, :3, 3] = (moved[:, :3, 3] + self.transform[:, 3]) * self.scale
        return moved

    def undone_before(self, other: Motion) -> Motion:
        """The inverse of this motion followed by ``other``; as in nerfstudio, transforms and scales
        are composed separately."""
        back = invert_rigid(self.transform[None])[0]
        last = other.transform.new_tensor([[0.0, 0.0, 0.0, 1.0]])
        return Motion((torch.cat([other.transform, last]) @ back)[:3], other.scale / self.scale)


@dataclass(frozen=True)
class CameraFile:
    """Content of a camera file."""

    cameras: Sequence[Camera]
    saved: Motion | None = None
    """Motion applied to the dataset's original world before the file was saved; None if no
    ``dataparser_transforms.json`` refers to the file's world."""


def finite(value: Any) -> float | None:
    """A finite number in JSON; None for any other value."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def matrix(values: Any, rows: tuple[int, ...], columns: int) -> list[list[float]] | None:
    """A JSON matrix as a list of rows, with NaN for numbers that are not finite; None if it has
    another shape."""
    if not isinstance(values, list) or len(values) not in rows:
        return None
    if not all(isinstance(row, list) and len(row) == columns for row in values):
        return None
    numbers = [[finite(value) for value in row] for row in values]
    return [[math.nan if number is None else number for number in row] for row in numbers]


def rigid(values: Tensor, whose: str, names: Sequence[str] = ()) -> Tensor:
    """Rigid motions (C, 3 or 4, 4) float64, with rotations orthonormal to the last bit.

    Args:
        values: matrices as read from the file.
        whose: start of the error message.
        names: photo names, if the matrices are camera poses; the error then names the first bad
            camera.

    Raises:
        DataError: if a number is not finite, or a matrix is not a rigid motion.
    """
    turn = values[:, :3, :3]
    off = (
        (turn @ turn.transpose(1, 2) - torch.eye(3, dtype=values.dtype, device="cpu"))
        .abs()
        .amax((1, 2))
    )
    most = 1e-3  # four printed digits stay below this error
    # False for NaN too
    good = values.isfinite().all(2).all(1) & (off <= most) & (torch.linalg.det(turn) > 0)
    if values.shape[1] == 4:
        good &= ((values[:, 3] - values.new_tensor([0.0, 0.0, 0.0, 1.0])).abs() <= most).all(1)
    if not bool(good.all()):
        camera = f" of camera {_first_bad(good, names)}" if names else ""
        raise DataError(
            f"{whose}{camera} is not a rigid motion; expected a rotation (no scale, no mirror) and "
            "a position, all finite; correct it or leave it out"
        )
    u, _, vh = torch.linalg.svd(turn)
    exact = values.clone()
    exact[:, :3, :3] = u @ vh
    return exact


def checked_views(path: Path, cameras: Sequence[Camera], motion: Motion | None) -> Views:
    """Convert cameras to views with a black background, each with the image size of its camera.

    Args:
        path: camera file, for error messages.
        cameras: cameras of the file.
        motion: moves the file's world to the scene's; None if they are the same.
    Returns:
        C views, float64 on the CPU.

    Raises:
        DataError: if there is no camera, there are too many, or one is invalid; the message gives
            its index in the file.
    """
    need_count(path, len(cameras))
    names = [camera.name for camera in cameras]
    poses = torch.tensor([camera.pose for camera in cameras], **DOUBLES).view(-1, 4, 4)
    poses = rigid(poses, f"{path}: the pose", names)
    if motion is not None:
        poses = motion.of(poses)
    sizes, focals, centres = (
        torch.tensor([camera[field] for camera in cameras], **DOUBLES).view(-1, 2)
        for field in (2, 3, 4)
    )
    reached = poses[:, :3, 3].abs().amax(1) <= 1e9  # squares stay finite in float32
    whole = ((sizes == sizes.floor()) & (sizes >= 1) & (sizes <= 100_000)).all(1)
    # fields of view of 179.9 and 0.0006 degrees
    long = ((focals >= 1e-3 * sizes) & (focals <= 1e5 * sizes)).all(1)
    near = (centres.abs() <= 100.0 * sizes).all(1)  # at most 100 image sizes from the corner
    for good, what, expected in (
        (reached, "is too far away", "at most 1e9 units"),
        (whole, "has an unusable image size", "1 to 100,000 pixels a side"),
        (long, "has no usable focal length", "a positive number of pixels"),
        (near, "has its principal point far outside of the image", "one in or near it"),
    ):
        if not bool(good.all()):
            camera = _first_bad(good, names)
            raise DataError(
                f"{path}: camera {camera} {what}; expected {expected}; correct it or leave it out"
            )
    images = [ImageSize(width, height) for width, height in sizes.long().tolist()]
    Ks = torch.eye(3, **DOUBLES).repeat(len(cameras), 1, 1)
    Ks[:, [0, 1], [0, 1]] = focals
    Ks[:, :2, 2] = centres
    background = torch.zeros(3, **FLOATS)
    size = images[0]
    return Views(invert_rigid(poses), Ks, size.width, size.height, background, images=images)


def photo_file(folders: Sequence[Path], name: str) -> Path | None:
    """The photo of a name in or below one of the folders, also without its suffix ``.png``; None if
    there is none. Never leaves the folders."""
    relative = PurePosixPath(name if "\0" not in name else "")
    if not relative.name or relative.is_absolute() or ".." in relative.parts:
        return None
    found = (folder / f"{relative}{suffix}" for folder in folders for suffix in ("", ".png"))
    with suppress(OSError):
        return next((file for file in found if file.is_file()), None)
    return None


def photo_order(names: Sequence[str]) -> list[int]:
    """Camera indices in natural order of photo names, r_2 before r_10; as is if one is missing."""
    order = list(range(len(names)))
    if all(names):
        order.sort(
            key=lambda index: re.sub(r"\d+", lambda digits: digits[0].zfill(20), names[index])
        )
    return order


def need_count(path: Path, count: int) -> None:
    """Raise a DataError if a file has no camera, or too many."""
    if not 0 < count <= MOST_CAMERAS:
        raise DataError(f"{path}: {count} cameras; expected 1 to {MOST_CAMERAS}")


def _first_bad(good: Tensor, names: Sequence[str]) -> str:
    """Index of the first camera that is not ``good`` (C,), with its photo name if it has one."""
    index = int((~good).nonzero()[0])
    return f"{index} ({names[index][:60]})" if names[index] else f"{index}"
