"""Which camera path a scene is shown along, from the views that there are of it."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import content_box
from pointsplat_ns.looking.sampling import sample_views
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.viewing.saved_path import MOST_FRAMES, MOST_PIXELS, read_path
from pointsplat_ns.viewing.trajectories import STOPS, along, fitted, orbit, walk
from pointsplat_ns.views import Views

FPS = 24.0
LONGEST_SIDE = 960
"""Maximum of the longer side of pictures from the poses of photos if no size is asked for, pixels."""


@dataclass(frozen=True)
class Shot:
    """Settings of a film; None is chosen by the scene."""

    width: int | None = None
    """Of a picture, pixels."""
    height: int | None = None
    fps: float | None = None
    """Frames a second."""
    seconds: float | None = None

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
    """One a frame."""
    fps: float
    """Frames a second."""
    origin: str
    """Text that says what the path is made of."""


def camera_path(
    scene: Gaussians,
    source: ViewSource,
    path: str | Path,
    shot: Shot,
    one: bool = False,
    up: Tensor | None = None,
) -> CameraPath:
    """The cameras of a film of a scene.

    Args:
        scene: N Gaussians.
        source: where views of it come from.
        path: "dataset" goes exactly through the poses of the run's dataset, "walk" past some views and "orbit" about
            what they show; "auto" is "dataset" if there is one, else "walk". Anything else is a file that nerfstudio's
            viewer saved.
        shot: size, speed and length.
        one: of only one picture, the first.
        up: (3,) of length 1, which way is up in a walk or an orbit; by default as the views have it, or is estimated.

    Raises:
        DataError: if there are no views, or the file is no camera path.
        SceneError: if there is no such file.
    """
    if str(path) not in ("auto", "dataset", "walk", "orbit"):
        saved = read_path(path)
        fps = shot.fps or saved.fps or FPS
        frames = 1 if one else len(saved.views) if shot.seconds is None else _frames(shot.seconds, fps)
        known = source.known(1)
        views = _sized(saved.views, shot, (saved.views.width, saved.views.height))
        if known is not None:
            views = dataclasses.replace(views, background=known.background, rasterize_mode=known.rasterize_mode)
        return CameraPath(views if frames == len(views) else along(views, frames), fps, f"the path of {path}")
    known = source.known(MOST_FRAMES)
    if path == "dataset" and known is None:
        raise DataError(f"no poses of a dataset{source.missing}; expected a run whose photos are found, or views")
    fps = shot.fps or FPS
    frames = 1 if one else _frames(10.0 if shot.seconds is None else shot.seconds, fps)
    if known is not None and path in ("auto", "dataset"):
        if shot.seconds is None and not one:
            frames = max(frames, len(known))
        usual = (known.width, known.height) if source.given is not None else _reduced(known)
        views = along(_sized(known, shot, usual), frames)
        skipped = f", {len(known) - frames} of {len(known)} left out" if frames < len(known) and not one else ""
        return CameraPath(views, fps, f"along the {source.origin}{skipped}")
    stops = known.spread(2 * STOPS) if known is not None else views_upright(scene, source, STOPS, up)
    stops = _sized(stops, shot, (960, 540) if known is None else _reduced(known))
    if path == "orbit":
        low, high = content_box(scene)
        return CameraPath(orbit(stops, frames, 0.5 * (low + high).cpu(), up), fps, f"a turn, by {source.origin}")
    return CameraPath(walk(stops, frames, up), fps, f"a walk past {source.origin}")


def views_upright(scene: Gaussians, source: ViewSource, count: int, up: Tensor | None) -> Views:
    """At most ``count`` views of a scene, sampled with ``up`` (3,) up if that is said and no poses are known.

    Raises:
        DataError: if there are none.
    """
    if up is None or source.known(1) is not None:
        return source.views(count)
    usual = source.views(1)
    sampled = sample_views(scene, count, up=up)
    return dataclasses.replace(sampled, rasterize_mode=usual.rasterize_mode)


def _frames(seconds: float, fps: float) -> int:
    return min(max(round(seconds * fps), 1), MOST_FRAMES)


def _reduced(views: Views) -> tuple[int, int]:
    """Width and height of photos, their longer side at most 960 pixels."""
    factor = min(1.0, LONGEST_SIDE / max(views.width, views.height))
    return round(views.width * factor), round(views.height * factor)


def _sized(views: Views, shot: Shot, usual: tuple[int, int]) -> Views:
    """The views at the size that is asked for, or at the usual width and height; even, as videos need it."""
    width, height = shot.width, shot.height
    if width is None:
        width = usual[0] if height is None else round(usual[0] * height / usual[1])
    if height is None:
        height = usual[1] if shot.width is None else round(usual[1] * width / usual[0])
    width, height = (max(side - side % 2, 2) for side in (width, height))
    return views if (width, height) == (views.width, views.height) else fitted(views, width, height)
