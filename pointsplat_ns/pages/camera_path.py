"""Chooses the camera path of a film from the views of a scene, or reads one that nerfstudio's viewer saved.

Files are not trusted: all values are checked.
"""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import viewmats_from_opengl
from pointsplat_ns.io.camera_files.cameras import finite
from pointsplat_ns.io.files import logger, one_line, require_file
from pointsplat_ns.looking.opening import opening_views
from pointsplat_ns.looking.upright import Up, known_up
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.pages.trajectories import along, fitted, toured
from pointsplat_ns.system.tensors import DOUBLES, FLOATS
from pointsplat_ns.views import Views

FPS = 24.0
"""Frames a second, unless something else is asked for."""

MOST_FRAMES = 100_000
"""Maximum number of cameras."""

MOST_PIXELS = 16_384
"""Maximum width and height of a picture."""

PHOTO_SIDE = 960
"""Largest longer side of pictures from the poses of photos, without a given size, pixels."""


@dataclass(frozen=True)
class FilmSettings:
    """Settings of a film; the scene decides those that are None."""

    width: int | None = None
    """Width of a picture, pixels."""
    height: int | None = None
    """Height of a picture, pixels."""
    fps: float | None = None
    """Frames a second."""
    seconds: float | None = None
    """Length of the film."""

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if value is not None and not 2 <= value <= MOST_PIXELS:
                raise PointSplatError(f"{name} is {value}; expected 2 to {MOST_PIXELS} pixels")
        if self.fps is not None and not 0.1 <= self.fps <= 1000:  # NaN fails too
            raise PointSplatError(f"fps is {self.fps:g}; expected 0.1 to 1000 frames a second")
        if self.seconds is not None and not 0 < self.seconds * (self.fps or FPS) <= MOST_FRAMES:
            raise PointSplatError(f"seconds are {self.seconds:g}; expected 1 to {MOST_FRAMES} frames in all")


@dataclass(frozen=True, eq=False)
class CameraPath:
    """The cameras of a film."""

    views: Views
    """One camera for each frame."""
    fps: float
    """Frames a second."""
    origin: str
    """Text on the origin of the path."""


def camera_path(
    scene: Gaussians,
    source: ViewSource,
    saved: str | Path | None,
    settings: FilmSettings,
    one: bool = False,
    up: Up | None = None,
) -> CameraPath:
    """Choose the cameras of a film of a scene: a saved path, else exactly through known views, else past sampled ones,
    which go around an object and through a room.

    Args:
        scene: N Gaussians.
        source: source of views.
        saved: the path of a file that nerfstudio's viewer saved.
        settings: size, speed and length.
        one: return one camera only: the first of a saved path, else the one that shows most.
        up: which way is up; by default what the scene declares, that of known views, or estimated.

    Raises:
        DataError: if there are no views, or the file is not a camera path.
        SceneError: if there is no such file.
    """
    up = known_up(up, scene)
    known = source.known(MOST_FRAMES)
    if saved is not None:
        path = read_path(saved)
        fps = settings.fps or path.fps
        frames = 1 if one else len(path.views) if settings.seconds is None else _frames(settings.seconds, fps)
        views = _sized(path.views, settings, (path.views.width, path.views.height))
        if known is not None:
            views = dataclasses.replace(views, background=known.background, rasterize_mode=known.rasterize_mode)
        return CameraPath(views if frames == len(views) else along(views, frames), fps, path.origin)
    fps = settings.fps or FPS
    frames = 1 if one else _frames(10.0 if settings.seconds is None else settings.seconds, fps)
    if known is None:
        opening = opening_views(scene, 1 if one else VIEW_COUNTS.walked, *_shape(settings, (960, 540)), up)
        stops = opening.views[[*range(len(opening.views)), 0]] if opening.whole else toured(opening.views)
        origin = f"{'around' if opening.whole else 'past'} what shows most, up is {opening.up}{source.missing}"
        return CameraPath(along(stops, frames, opening.up.direction), fps, origin)
    if settings.seconds is None and not one:
        frames = max(frames, len(known))
    usual = known if source.given is not None else known.resized(PHOTO_SIDE)
    if one:
        known = opening_views(scene, up=up, known=known.spread(4 * VIEW_COUNTS.walked)).views
    views = along(_sized(known, settings, (usual.width, usual.height)), frames)
    skipped = f", {len(known) - frames} of {len(known)} left out" if frames < len(known) and not one else ""
    return CameraPath(views, fps, f"along the {source.origin}{skipped}")


def _frames(seconds: float, fps: float) -> int:
    return min(max(round(seconds * fps), 1), MOST_FRAMES)


def _sized(views: Views, settings: FilmSettings, usual: tuple[int, int]) -> Views:
    """The views at the size of :func:`_shape`."""
    width, height = _shape(settings, usual)
    return views if (width, height) == (views.width, views.height) else fitted(views, width, height)


def _shape(settings: FilmSettings, usual: tuple[int, int]) -> tuple[int, int]:
    """Width and height of the settings, or the usual ones; even numbers, as videos need."""
    width, height = settings.width, settings.height
    if width is None:
        width = usual[0] if height is None else round(usual[0] * height / usual[1])
    if height is None:
        height = usual[1] if settings.width is None else round(usual[1] * width / usual[0])
    return max(width - width % 2, 2), max(height - height % 2, 2)


def read_path(path: Path | str) -> CameraPath:
    """Read a camera path: JSON with ``camera_path``, ``render_width`` and ``render_height``, as nerfstudio's viewer
    saves it. Cameras are float64, over black; without a speed there are 24 frames a second. Raises SceneError if there
    is no such file, and DataError if it is too large, is not such JSON, has another camera model, or has an invalid
    camera."""
    path = require_file(path, "a camera path saved by nerfstudio's viewer (JSON)")
    if path.stat().st_size > 64_000_000:  # nerfstudio writes about 500 bytes a frame
        raise DataError(f"{path}: {path.stat().st_size / 1e6:.0f} MB; expected a camera path of at most 64 MB")
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: cannot be read as JSON ({one_line(error, 80)})") from error
    cameras = content.get("camera_path") if isinstance(content, dict) else None
    if not isinstance(cameras, list) or not 0 < len(cameras) <= MOST_FRAMES:
        raise DataError(f"{path}: no camera path; expected 'camera_path', a list of 1 to {MOST_FRAMES} cameras")
    kind = content.get("camera_type", "perspective")
    if kind != "perspective":
        raise DataError(f"{path}: cameras are {str(kind)[:40]!r}; expected perspective ones")
    sides = [finite(content.get(name)) or 0.0 for name in ("render_width", "render_height")]
    if not all(side == int(side) and 1 <= side <= MOST_PIXELS for side in sides):
        found = f"{content.get('render_width')!r:.40} x {content.get('render_height')!r:.40}"
        raise DataError(f"{path}: a picture of {found} pixels; expected 1 to {MOST_PIXELS} a side")
    if content.get("crop"):
        logger.warning("%s: its crop is not applied", path)
    width, height = map(int, sides)
    read = [_camera(camera, f"{path}: camera {index}") for index, camera in enumerate(cameras)]
    poses, fovs = zip(*read, strict=True)
    Ks = torch.zeros(len(cameras), 3, 3, **DOUBLES)
    focals = [0.5 * height / math.tan(math.radians(fov) / 2) for fov in fovs]
    Ks[:, 0, 0] = Ks[:, 1, 1] = torch.tensor(focals, **DOUBLES)
    Ks[:, 0, 2], Ks[:, 1, 2], Ks[:, 2, 2] = width / 2, height / 2, 1.0
    fps = finite(content.get("fps"))
    views = Views(viewmats_from_opengl(torch.stack(poses)), Ks, width, height, torch.zeros(3, **FLOATS))
    return CameraPath(views, fps if fps is not None and 0 < fps <= 1000 else FPS, f"the path of {path}")


def _camera(camera: Any, name: str) -> tuple[Tensor, float]:
    """Pose (3, 4) from camera to world, OpenGL axes, and field of view in degrees."""
    values = camera.get("camera_to_world") if isinstance(camera, dict) else None
    numbers = [finite(value) for value in values] if isinstance(values, list) and len(values) == 16 else [None]
    if None in numbers:
        raise DataError(f"{name} has no pose; expected 'camera_to_world', 16 finite numbers")
    pose = torch.tensor(numbers, **DOUBLES).view(4, 4)
    turn = pose[:3, :3]
    off = (turn @ turn.T - torch.eye(3, **DOUBLES)).abs().max()
    last = (pose[3] - torch.eye(4, **DOUBLES)[3]).abs().max()
    if not bool((off <= 1e-3) & (last <= 1e-3) & (torch.linalg.det(turn) > 0)):  # nerfstudio writes 16 digits
        raise DataError(f"{name}: its pose is no rigid motion; expected a rotation and a position")
    if float(pose[:3, 3].abs().max()) > 1e9:  # its square is finite in float32
        raise DataError(f"{name} is farther than 1e+09 units from the origin; expected it nearer")
    fov = finite(camera.get("fov"))
    if fov is None or not 0.1 <= fov <= 179:
        raise DataError(f"{name} has a fov of {str(camera.get('fov'))[:40]}; expected 0.1 to 179 degrees")
    return pose[:3], fov
