"""Makes films of one scene, or of two side by side: cameras and frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.tools.pages.image_encoding import to_uint8, with_labels
from pointsplat_ns.tools.wording import missing_text, origin_text
from pointsplat_ns.view_sampling.opening_views import opening_views
from pointsplat_ns.view_sampling.poses import look_at
from pointsplat_ns.view_sampling.upright import Up

MOST_FRAMES = 100_000
"""Maximum number of cameras."""

PHOTO_SIDE = 960
"""Maximum longer side of pictures from poses of photos, unless a size is given, pixels."""


@dataclass(frozen=True)
class FilmSettings:
    """Settings of a film. None leaves a setting to the scene."""

    width: int | None = None  # of a picture, pixels
    height: int | None = None
    fps: float = 24.0  # frames per second
    seconds: float | None = None  # length of the film

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            value = getattr(self, name)
            if value is not None and not 2 <= value <= 16_384:
                raise PointSplatError(f"{name} is {value}; expected 2 to 16384 pixels")
        if not 0.1 <= self.fps <= 1000:  # NaN fails too
            raise PointSplatError(f"fps is {self.fps:g}; expected 0.1 to 1000 frames per second")
        if self.seconds is not None and not 0 < self.seconds * self.fps <= MOST_FRAMES:
            raise PointSplatError(
                f"seconds are {self.seconds:g}; expected 1 to {MOST_FRAMES} frames in all"
            )

    def shape(self, width: int, height: int) -> tuple[int, int]:
        """Width and height of pictures, from defaults; even, as videos require."""
        wide = self.width or (width if self.height is None else round(width * self.height / height))
        high = self.height or (height if self.width is None else round(height * self.width / width))
        return max(wide - wide % 2, 2), max(high - high % 2, 2)


def camera_path(
    scene: Gaussians,
    source: ViewProvider,
    settings: FilmSettings,
    one: bool = False,
    up: Up | None = None,
) -> tuple[Views, str]:
    """Cameras of a film, one per frame, and a text on their origin. They pass exactly through known
    views, else through sampled ones, which circle an object or walk through a room.

    Args:
        scene: N Gaussians.
        source: source of views.
        settings: size, speed and length.
        one: whether to return a single camera: the one that shows most.
        up: up direction; by default declared by the scene, from known views, or estimated.

    Raises:
        DataError: if there are no views.
    """
    known = source.known(MOST_FRAMES)
    seconds = 10.0 if settings.seconds is None else settings.seconds
    frames = 1 if one else min(max(round(seconds * settings.fps), 1), MOST_FRAMES)
    if known is None:
        opening = opening_views(
            scene, 1 if one else VIEW_COUNTS.walked, *settings.shape(960, 540), up
        )
        if opening.whole:
            stops = opening.views[[*range(len(opening.views)), 0]]
            path = "around the object"
        else:
            stops = toured(opening.views)
            path = "past the views that show most"
        origin = f"{path}, up is {opening.up}{missing_text(source.missing)}"
        return along(stops, frames, opening.up.direction), origin
    if settings.seconds is None and not one:
        frames = max(frames, len(known))
    usual = known if source.given is not None else known.resized(PHOTO_SIDE)
    skipped = ""
    if frames < len(known) and not one:
        skipped = f", {len(known) - frames} of {len(known)} skipped"
    if one:
        known = opening_views(scene, up=up, known=known.spread(4 * VIEW_COUNTS.walked)).views
    known = fitted(known, *settings.shape(usual.width, usual.height))
    return along(known, frames), f"along the {origin_text(source.origin)}{skipped}"


def along(views: Views, frames: int, up: Tensor | None = None) -> Views:
    """A smooth path of ``frames`` cameras (float64), exactly through all views in order. If there
    are more views than frames, some are skipped.

    Positions are interpolated without overshoot (PCHIP), rotations with continuous acceleration (a
    spline of rotations). With ``up`` (3,), cameras between the views do not roll about it. The time
    between views is proportional to their distance plus their angle. Raises DataError if there is
    no view.
    """
    if len(views) == 0:
        raise DataError("a camera path needs views to go through; expected at least one")
    views = views.spread(frames)
    own = views.viewmats.detach().double().cpu()
    Ks = views.Ks.double().cpu()
    if len(views) == 1:
        return dataclasses.replace(
            views, viewmats=own.repeat(frames, 1, 1), Ks=Ks.repeat(frames, 1, 1)
        )
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, RotationSpline

    poses = _poses(views)
    done = np.cumsum([0.0, *_distances(poses[:-1], poses[1:])])
    share = done / done[-1] if done[-1] > 0 else np.arange(len(views)) / (len(views) - 1)
    spare = np.round((frames - len(views)) * share).astype(int)
    knots = np.arange(len(views)) + spare  # frame index of each view
    eyes = torch.from_numpy(PchipInterpolator(knots, poses[:, :3, 3])(np.arange(frames)))
    spline = RotationSpline(knots, Rotation.from_matrix(poses[:, :3, :3]))
    rotations = torch.from_numpy(spline(np.arange(frames)).as_matrix())
    if up is None:
        viewmats = invert_rigid(torch.cat([rotations, eyes[:, :, None]], dim=2))
    else:
        viewmats = look_at(eyes, eyes + rotations[:, :, 2], up)
    viewmats[knots] = own  # bit for bit
    place = np.interp(np.arange(frames), knots, range(len(views)))
    low = torch.from_numpy(np.floor(place)).long()
    high = (low + 1).clamp_max(len(views) - 1)
    part = torch.from_numpy(place)[:, None, None] - low[:, None, None]
    Ks = torch.lerp(Ks[low], Ks[high], part)
    return dataclasses.replace(views, viewmats=viewmats, Ks=Ks)


def toured(views: Views) -> Views:
    """Views ordered greedily for a short path: from the first always to the nearest remaining
    one."""
    poses = _poses(views)
    distances = _distances(poses[:, None], poses[None])
    order = [0]
    left = set(range(1, len(views)))
    while left:
        order.append(min(left, key=lambda other: (distances[order[-1], other], other)))
        left.remove(order[-1])
    return views[order]


def fitted(views: Views, width: int, height: int) -> Views:
    """The same cameras with pictures of another size, one for all. The vertical field of view
    stays."""
    if views.images is not None:
        return views.each_size(lambda of_size: fitted(of_size, width, height))
    factor = height / views.height
    Ks = views.Ks.double() * factor
    Ks[:, 0, 2] = width / 2 + (views.Ks[:, 0, 2].double() - views.width / 2) * factor
    Ks[:, 2, 2] = 1.0
    return dataclasses.replace(views, Ks=Ks, width=width, height=height)


def _poses(views: Views) -> np.ndarray:
    """Poses, camera to world (C, 4, 4), OpenCV axes, float64."""
    return invert_rigid(views.viewmats.detach().double().cpu()).numpy()


def _distances(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distance between poses (..., 4, 4): distance of positions over its mean, plus the angle in
    radians."""
    way = np.linalg.norm(others[..., :3, 3] - poses[..., :3, 3], axis=-1)
    trace = (others[..., :3, :3] * poses[..., :3, :3]).sum((-1, -2))
    return way / max(float(way.mean()), 1e-300) + np.arccos(np.clip((trace - 1) / 2, -1, 1))


def render_frames(
    scenes: Sequence[Gaussians], views: Views, labels: Sequence[str] = ()
) -> Iterator[np.ndarray]:
    """Draw the frames (H, W, 3) uint8 of one scene, or of two side by side with labels and a
    dividing line."""
    for view in views:
        with torch.no_grad():
            pixels = np.concatenate([to_uint8(render(scene, view)) for scene in scenes], axis=1)
        if len(scenes) > 1:  # white with dark sides, visible on any background
            thick = 2 if pixels.shape[1] >= 640 else 1
            left = view.width - thick // 2
            pixels[:, left - 1 : left + thick + 1] //= 3
            pixels[:, left : left + thick] = 255
        yield with_labels(pixels, labels) if labels else pixels
