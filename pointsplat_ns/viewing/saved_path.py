"""Reads camera paths that nerfstudio's viewer saved. Files are not trusted: all values are checked."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.cameras import viewmats_from_opengl
from pointsplat_ns.io.camera_files.cameras import finite
from pointsplat_ns.io.files import logger, one_line, require_file
from pointsplat_ns.views import Views


@dataclass(frozen=True)
class PathLimits:
    """Limits of camera paths."""

    bytes: int = 64_000_000
    """Maximum size of a file: nerfstudio writes about 500 bytes a frame."""
    frames: int = 100_000
    """Maximum number of cameras."""
    pixels: int = 16_384
    """Maximum width and height of a picture."""
    coordinate: float = 1e9
    """Largest coordinate of a camera, scene units: its square is finite in float32."""


LIMITS = PathLimits()


@dataclass(frozen=True, eq=False)
class SavedPath:
    """A saved camera path."""

    views: Views
    """One camera for each frame, float64, with a black background."""
    fps: float | None
    """Frames a second; None if the file does not say."""


def read_path(path: Path | str) -> SavedPath:
    """Read a camera path: JSON with ``camera_path``, ``render_width`` and ``render_height``, as nerfstudio's viewer
    saves it. Raises SceneError if there is no such file, and DataError if it is too large, is not such JSON, has
    another camera model, or has an invalid camera."""
    path = require_file(path, "a camera path saved by nerfstudio's viewer (JSON)")
    if path.stat().st_size > LIMITS.bytes:
        raise DataError(f"{path}: {path.stat().st_size / 1e6:.0f} MB; expected a camera path of at most 64 MB")
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({one_line(error, 80)})") from error
    cameras = content.get("camera_path") if isinstance(content, dict) else None
    if not isinstance(cameras, list) or not 0 < len(cameras) <= LIMITS.frames:
        raise DataError(f"{path}: no camera path; expected 'camera_path', a list of 1 to {LIMITS.frames} cameras")
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise DataError(f"{path}: cameras are {str(kind)[:40]!r}; expected perspective ones")
    width, height = (_size(content.get(name), name, path) for name in ("render_width", "render_height"))
    if content.get("crop"):
        logger.warning("%s: its crop is not applied", path)
    poses, focals = zip(*(_camera(camera, index, height, path) for index, camera in enumerate(cameras)), strict=True)
    Ks = torch.zeros(len(cameras), 3, 3, dtype=torch.float64)
    Ks[:, 0, 0] = Ks[:, 1, 1] = torch.tensor(focals, dtype=torch.float64)
    Ks[:, 0, 2], Ks[:, 1, 2], Ks[:, 2, 2] = width / 2, height / 2, 1.0
    fps = finite(content.get("fps"))
    views = Views(viewmats_from_opengl(torch.stack(poses)), Ks, width, height, torch.zeros(3))
    return SavedPath(views, fps if fps is not None and 0 < fps <= 1000 else None)


def _size(value: Any, name: str, path: Path) -> int:
    number = finite(value)
    if number is None or number != int(number) or not 1 <= number <= LIMITS.pixels:
        raise DataError(f"{path}: {name} is {str(value)[:40]}; expected 1 to {LIMITS.pixels} pixels")
    return int(number)


def _camera(camera: Any, index: int, height: int, path: Path) -> tuple[Tensor, float]:
    """Pose (3, 4) from camera to world, OpenGL axes, and focal length in pixels."""
    values = camera.get("camera_to_world") if isinstance(camera, dict) else None
    numbers = [finite(value) for value in values] if isinstance(values, list) and len(values) == 16 else [None]
    if any(number is None for number in numbers):
        raise DataError(f"{path}: camera {index} has no pose; expected 'camera_to_world', 16 finite numbers")
    pose = torch.tensor(numbers, dtype=torch.float64).view(4, 4)
    turn = pose[:3, :3]
    off = (turn @ turn.T - torch.eye(3)).abs().max()
    last = (pose[3] - pose.new_tensor([0.0, 0.0, 0.0, 1.0])).abs().max()
    rigid = (off <= 1e-3) & (last <= 1e-3) & (torch.linalg.det(turn) > 0)  # nerfstudio writes 16 digits
    if not bool(rigid):  # NaN fails too
        raise DataError(f"{path}: the pose of camera {index} is no rigid motion; expected a rotation and a position")
    if float(pose[:3, 3].abs().max()) > LIMITS.coordinate:
        raise DataError(
            f"{path}: camera {index} is farther than {LIMITS.coordinate:g} units from the origin; expected it nearer"
        )
    fov = finite(camera.get("fov"))
    if fov is None or not 0.1 <= fov <= 179:
        raise DataError(f"{path}: fov of camera {index} is {str(camera.get('fov'))[:40]}; expected 0.1 to 179 degrees")
    return pose[:3], 0.5 * height / math.tan(math.radians(fov) / 2)
