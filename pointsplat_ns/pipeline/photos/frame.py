"""Finds the frame of a scene without a nerfstudio run, by comparing small renders with photos.

Camera files use the frame of the data. A scene may use another: nerfstudio and gsplat rotate,
centre and scale the data before training; conventions for up and camera axes differ; editors scale
scenes.

Thresholds are tuned on nine captures. The correlation of photos and renders is 0.83 to 0.92 in the
right frame, at most 0.32 with permuted axes of the world or the cameras, and 0.4 to 0.8 at 80 % of
the scale.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import flip_camera_axes, invert_rigid, smallest_turn
from pointsplat_ns.pipeline.photos.pose_check import (
    MIN_LIKENESS,
    POSE_CHECK,
    Likeness,
    Photo,
    likeness,
)
from pointsplat_ns.scene.camera_files import NamedViews
from pointsplat_ns.scene.camera_files.camera_views import Motion
from pointsplat_ns.scene.camera_files.colmap import colmap_points
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views, spread_indices
from pointsplat_ns.system.files import logger
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.view_sampling.content import thinned

SAME_SCALE = 0.02
"""Deviation of a scale from 1 that is ignored."""

Frame = tuple[str, Tensor]
"""Description of the motion to a frame, and poses (C, 4, 4), camera to world, in it."""


def in_frame(
    scene: Gaussians, named: NamedViews, photos: Mapping[int, Photo], model: Path
) -> Views:
    """Views of a camera file in the frame of a scene, over the background of its photos, black or
    white. A change of frame is logged in one line.

    Args:
        scene: N Gaussians.
        named: views from :func:`~pointsplat_ns.scene.camera_files.read_named_views`.
        photos: small photos of some views, by view index.
        model: path of the camera file.

    Raises:
        DataError: if renders do not match the photos in any tried frame.
    """
    search = _Search(scene, named, photos, model)
    given = search.fit(search.poses)
    found, words, poses = search.best(given)
    search.background = 1.0
    if _fits(found):
        white = search.fit(poses)
    else:
        white, words, poses = search.best(search.fit(search.poses))
    if white.psnr > found.psnr + 1.0 and _fits(white):
        found = white
        logger.info("the photos have a white background")
    else:
        search.background = 0.0
    if not _fits(found):
        raise DataError(
            f"{model}: renders of the scene do not match the photos in the frame of these poses or "
            f"in any other tried ({given.psnr:.1f} dB PSNR in {given.count} photos, "
            f"correlation {given.own:.2f}; at best {found.psnr:.1f} dB and {found.own:.2f}); "
            "expected the poses and photos of the scene's training, in its frame: put the "
            "dataparser_transforms.json of its run beside the scene, or name other poses (--poses)"
        )
    if words:
        logger.info(
            "poses are moved into the frame of the scene: %s (%.1f -> %.1f dB PSNR in %d small "
            "photos)",
            ", ".join(words),
            given.psnr,
            found.psnr,
            found.count,
        )
    return search.views_of(poses)


def _fits(found: Likeness) -> bool:
    """Whether renders match their own photos, and clearly better than photos of other views, which
    show the same object or sky: by at least 30 % of the possible margin. Right frames reach 80 %
    and more."""
    return found.own >= max(MIN_LIKENESS, found.others + 0.3 * (1 - found.others))


class _Search:
    """Compares photos with renders in candidate frames over one background."""

    def __init__(
        self, scene: Gaussians, named: NamedViews, photos: Mapping[int, Photo], model: Path
    ):
        self.background = 0.0
        self.poses = invert_rigid(named.views.viewmats)
        self._views = replace(
            named.views, rasterize_mode="antialiased" if scene.antialiased else "classic"
        )
        self._offset = scene.offset
        self._drawn = thinned(scene, POSE_CHECK.max_count)
        self._photos = photos
        self._indices = list(photos)
        self._few = [self._indices[place] for place in spread_indices(len(photos), 4)]
        self._known = _known_frames(named, self.poses, model)

    def views_of(self, poses: Tensor) -> Views:
        """Views from poses (C, 4, 4) in the scene's frame."""
        background = torch.full_like(self._views.background, self.background)
        return replace(
            self._views, viewmats=invert_rigid(poses), background=background
        ).relative_to(self._offset)

    def fit(self, poses: Tensor, few: bool = False) -> Likeness:
        """Likeness of renders from poses to all photos, or to a few."""
        views = self.views_of(poses)
        shown: list[Photo] = []
        for index in self._few if few else self._indices:
            view, image, mask = self._photos[index]
            small = replace(views[index], K=view.K, width=view.width, height=view.height)
            shown.append((small, image, mask))
        return likeness(self._drawn, shown)

    def best(self, given: Likeness) -> tuple[Likeness, list[str], Tensor]:
        """The greatest likeness, descriptions of the motions to its frame, and poses in it;
        ``given`` is the likeness in the given frame."""
        found = given
        words = ""
        poses = self.poses
        others = [self._known]
        if given.own < 0.75 or not _fits(given):
            turnable = [frame for frame in self._known if frame[0] in ("", _GSPLAT)]
            others.append([*_turned_frames(turnable)])
        for frames in others:
            text, best = max(
                frames, key=lambda frame: self.fit(frame[1], few=frames is not self._known).own
            )
            if (other := self.fit(best)).own > found.own + 0.02:
                found = other
                words = text
                poses = best
        start = poses
        scale = _best_scale(lambda factor: self.fit(_scaled(start, factor)).own)
        named = [words] if words else []
        if abs(scale - 1) <= SAME_SCALE:
            return found, named, poses
        scaled = _scaled(poses, scale)
        return self.fit(scaled), [*named, f"positions times {scale:.4g}"], scaled


def _scaled(poses: Tensor, factor: float) -> Tensor:
    return Motion(torch.eye(4, **DOUBLES)[:3], factor).of(poses)


def _best_scale(likeness_at: Callable[[float], float]) -> float:
    """Scale of positions with the greatest likeness, by hill climbing with ever smaller steps. It
    starts from 1, or from the best of 41 scales between 0.01 and 100 if the likeness at 1 is
    low."""
    scale = 1.0
    if likeness_at(scale) < MIN_LIKENESS:
        scale = max((1.25**power for power in range(-20, 21)), key=likeness_at)
    for step in (1.1, 1.01, 1.002):
        at = functools.cache(lambda power, start=scale, step=step: likeness_at(start * step**power))
        power = 0
        while abs(power) < 48:
            best = max((power, power - 1, power + 1), key=at)
            if best == power:
                break
            power = best
        low = at(power - 1)
        middle = at(power)
        high = at(power + 1)
        bend = low - 2 * middle + high
        scale *= step ** (power + (0.5 * (low - high) / bend if bend < 0 else 0.0))
        if abs(scale - 1) <= SAME_SCALE:
            break
    return scale


_GSPLAT = "normalised as gsplat does"


def _known_frames(named: NamedViews, poses: Tensor, model: Path) -> list[Frame]:
    """Candidate frames: the given one first, then frames from files, then those of nerfstudio and
    gsplat."""
    frames = [("", poses)]
    raw = poses
    if named.motion is not None:
        raw = _undone(named.motion, poses)
        frames.append(("without dataparser_transforms.json", raw))
    if named.saved is not None:
        frames.append(("applied_transform undone", _undone(named.saved, raw)))
        upright = Motion(torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]], **DOUBLES))
        for start in (raw, upright.of(raw)):
            text = "oriented, centred and scaled as nerfstudio does"
            frames.append((text, _as_nerfstudio(start)))
        if (points := colmap_points(model)) is not None:
            frames.append((_GSPLAT, _as_gsplat(raw, points)))
    return frames


def _turned_frames(frames: list[Frame]) -> Iterator[Frame]:
    """Frames with permuted axes of the world, with OpenGL in place of OpenCV camera axes, or
    both."""
    for text, poses in frames:
        for turn in _axis_turns():
            turned = _turned(poses, turn)
            words = [text, _turn_text(turn)]
            yield ", ".join(filter(None, words)), turned
            words.append("camera axes y and z flipped")
            yield ", ".join(filter(None, words)), flip_camera_axes(turned)


def _turned(poses: Tensor, turn: Tensor, move: Tensor | None = None) -> Tensor:
    """Poses after a rotation (3, 3) of the world and a translation (3,)."""
    move = torch.zeros(3, **DOUBLES) if move is None else move
    return Motion(torch.cat([turn, move[:, None]], dim=1)).of(poses)


def _undone(motion: Motion, poses: Tensor) -> Tensor:
    """Poses before ``motion``."""
    turn = motion.transform[:, :3]
    move = motion.transform[:, 3]
    before = poses.clone()
    before[:, :3] = turn.T @ poses[:, :3]
    before[:, :3, 3] = (poses[:, :3, 3] / motion.scale - move) @ turn
    return before


def _as_nerfstudio(poses: Tensor) -> Tensor:
    """Poses normalised as by nerfstudio's dataparsers: mean up direction along z, mean position at
    the origin, largest coordinate 1."""
    turn = smallest_turn(_up(poses), torch.tensor([0.0, 0.0, 1.0], **DOUBLES))
    moved = _turned(poses, turn, -(turn @ poses[:, :3, 3].mean(0)))
    return _scaled(moved, 1 / max(float(moved[:, :3, 3].abs().max()), 1e-12))


def _as_gsplat(poses: Tensor, points: Tensor) -> Tensor:
    """Poses normalised as by gsplat's examples with the points (N, 3) of a COLMAP model, up to the
    signs of axes: centre at the median point that cameras look at, median distance of cameras 1,
    principal axes of the points.

    Source: ``normalize`` in ``examples/datasets/normalize.py`` of gsplat.
    """
    turn = smallest_turn(_up(poses), torch.tensor([0.0, -1.0, 0.0], **DOUBLES))
    poses = _turned(poses, turn)
    points = points @ turn.T
    positions = poses[:, :3, 3]
    ahead = poses[:, :3, 2]
    centre = (positions - (ahead * positions).sum(1, keepdim=True) * ahead).quantile(0.5, dim=0)
    scale = 1 / float((positions - centre).norm(dim=1).quantile(0.5).clamp_min(1e-12))
    middle = points.quantile(0.5, dim=0)
    axes = torch.linalg.eigh((points - middle).T.cov()).eigenvectors.flip(1).T
    axes = axes * torch.linalg.det(axes).sign()
    return _scaled(_turned(poses, axes, -(axes @ middle)), scale)


def _up(poses: Tensor) -> Tensor:
    """Mean up direction of the cameras, (3,), of length 1."""
    up = -poses[:, :3, 1].mean(0)
    return up / up.norm().clamp_min(1e-9)


def _axis_turns() -> Iterator[Tensor]:
    """The 24 rotations (3, 3) that map axes to axes, the identity first."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            turn = torch.zeros(3, 3, **DOUBLES)
            turn[[0, 1, 2], list(order)] = torch.tensor(signs, **DOUBLES)
            if float(torch.linalg.det(turn)) > 0:
                yield turn


def _turn_text(turn: Tensor) -> str:
    """Text on a rotation: axes of the scene in terms of the poses' axes; empty for the identity."""
    axes = [("-" if float(row.sum()) < 0 else "") + "xyz"[int(row.abs().argmax())] for row in turn]
    if axes == ["x", "y", "z"]:
        return ""
    return f"axes x, y, z of the scene are {', '.join(axes)} of the poses"
