"""Chooses the camera path of a film from the views of a scene."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import content_box
from pointsplat_ns.looking.opening import opening_views
from pointsplat_ns.looking.upright import Up
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.viewing.saved_path import LIMITS, read_path
from pointsplat_ns.viewing.trajectories import STOPS, along, fitted, orbit, walk
from pointsplat_ns.views import Views

FPS = 24.0
LONGEST_SIDE = 960
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
            if value is not None and not 2 <= value <= LIMITS.pixels:
                raise PointSplatError(f"{name} is {value}; expected 2 to {LIMITS.pixels} pixels")
        if self.fps is not None and not 0.1 <= self.fps <= 1000:  # NaN fails too
            raise PointSplatError(f"fps is {self.fps:g}; expected 0.1 to 1000 frames a second")
        if self.seconds is not None and not 0 < self.seconds * (self.fps or FPS) <= LIMITS.frames:
            raise PointSplatError(f"seconds are {self.seconds:g}; expected 1 to {LIMITS.frames} frames in all")


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
    path: str | Path,
    settings: FilmSettings,
    one: bool = False,
    up: Up | None = None,
) -> CameraPath:
    """Choose the cameras of a film of a scene.

    Args:
        scene: N Gaussians.
        source: source of views.
        path: "dataset" goes exactly through the poses of the run's dataset, "walk" past some views and "orbit" about
            their common content; "auto" is "dataset" if there is one, else "walk". Any other text is the path of a file
            that nerfstudio's viewer saved.
        settings: size, speed and length.
        one: return one camera only: the one that shows most, unless the path says which.
        up: which way is up, for a walk or an orbit; by default that of known views, or estimated.

    Raises:
        DataError: if there are no views, or the file is not a camera path.
        SceneError: if there is no such file.
    """
    if str(path) not in ("auto", "dataset", "walk", "orbit"):
        saved = read_path(path)
        fps = settings.fps or saved.fps or FPS
        frames = 1 if one else len(saved.views) if settings.seconds is None else _frames(settings.seconds, fps)
        known = source.known(1)
        views = _sized(saved.views, settings, (saved.views.width, saved.views.height))
        if known is not None:
            views = dataclasses.replace(views, background=known.background, rasterize_mode=known.rasterize_mode)
        return CameraPath(views if frames == len(views) else along(views, frames), fps, f"the path of {path}")
    known = source.known(LIMITS.frames)
    if path == "dataset" and known is None:
        raise DataError(f"no poses of a dataset{source.missing}; expected a run whose photos are found, or views")
    fps = settings.fps or FPS
    frames = 1 if one else _frames(10.0 if settings.seconds is None else settings.seconds, fps)
    if known is not None and path in ("auto", "dataset"):
        if settings.seconds is None and not one:
            frames = max(frames, len(known))
        usual = (known.width, known.height) if source.given is not None else _reduced(known)
        if one and path == "auto":
            known = opening_views(scene, up=up, known=known.spread(4 * STOPS)).views
        views = along(_sized(known, settings, usual), frames)
        skipped = f", {len(known) - frames} of {len(known)} left out" if frames < len(known) and not one else ""
        return CameraPath(views, fps, f"along the {source.origin}{skipped}")
    if known is None:
        opening = opening_views(scene, 1 if one else STOPS, *_shape(settings, (960, 540)), up)
        stops = dataclasses.replace(opening.views, rasterize_mode=source.rasterize_mode)
        up, origin = opening.up, f"views that show most, up is {opening.up}{source.missing}"
    else:
        stops, origin = _sized(known.spread(2 * STOPS), settings, _reduced(known)), source.origin
    upward = None if up is None else up.direction
    if path == "orbit":
        low, high = content_box(scene)
        return CameraPath(orbit(stops, frames, 0.5 * (low + high).cpu(), upward), fps, f"a turn, by {origin}")
    return CameraPath(walk(stops, frames, upward, from_first=known is None), fps, f"a walk past {origin}")


def _frames(seconds: float, fps: float) -> int:
    return min(max(round(seconds * fps), 1), LIMITS.frames)


def _reduced(views: Views) -> tuple[int, int]:
    """Width and height of photos, their longer side at most 960 pixels."""
    factor = min(1.0, LONGEST_SIDE / max(views.width, views.height))
    return round(views.width * factor), round(views.height * factor)


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
