"""Camera paths from views of a scene: exactly through them, or an upright walk past them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.looking.upright import level_directions
from pointsplat_ns.views import Views


def along(views: Views, frames: int) -> Views:
    """A smooth path exactly through views, in their order, each of which is one of its ``frames`` cameras (float64);
    some views are left out if there are more.

    Positions are interpolated without overshoot (PCHIP), rotations with continuous acceleration (a spline of
    rotations). The time between two views is proportional to their distance plus their angle. Raises DataError if there
    is no view, or ``frames`` is not positive.
    """
    views = _spread(views, frames)
    places, turns = _poses(views)
    knots = _knots(_lengths(places, turns), frames)
    if len(views) == 1:
        return _posed(views, views.viewmats.double().repeat(frames, 1, 1), np.zeros(frames), [0])
    from scipy.spatial.transform import Rotation, RotationSpline

    rotations = RotationSpline(knots, Rotation.from_matrix(turns))(np.arange(frames)).as_matrix()
    viewmats = _viewmats(_smooth(knots, places, frames), rotations)
    viewmats[knots] = views.viewmats.double()  # to the bit
    return _posed(views, viewmats, np.interp(np.arange(frames), knots, range(len(knots))), knots)


def walk(views: Views, frames: int, up: Tensor) -> Views:
    """A smooth, upright walk of ``frames`` cameras (float64) past views, in their order. Cameras do not roll about
    ``up`` (3,) of length 1. Raises DataError if there is no view, or ``frames`` is not positive."""
    views = _spread(views, frames)
    places, turns = _poses(views)
    knots = _knots(_lengths(places, turns), frames)
    yaw, pitch = _angles(torch.from_numpy(turns[:, :, 2]), up)
    angles = np.stack([np.unwrap(yaw.numpy()), pitch.numpy()], axis=1)
    angles = angles.repeat(frames, axis=0) if len(views) == 1 else _smooth(knots, angles, frames)
    eyes = places.repeat(frames, axis=0) if len(views) == 1 else _smooth(knots, places, frames)
    viewmats = _upright(torch.from_numpy(eyes), torch.from_numpy(angles), up)
    return _posed(views, viewmats, np.interp(np.arange(frames), knots, range(len(knots))), knots)


def toured(views: Views) -> Views:
    """Views in a short order: from the first one always to the nearest of those that are left."""
    places, turns = _poses(views)
    way = np.linalg.norm(places[:, None] - places[None], axis=2)
    trace = np.einsum("aij,bij->ab", turns, turns)
    # distance of positions over its mean, plus the angle in radians
    distances = way / max(float(way.mean()), 1e-300) + np.arccos(np.clip((trace - 1) / 2, -1, 1))
    order, left = [0], set(range(1, len(views)))
    while left:
        order.append(min(left, key=lambda other: (distances[order[-1], other], other)))
        left.remove(order[-1])
    return views[order]


def fitted(views: Views, width: int, height: int) -> Views:
    """The same cameras with pictures of another size. The vertical field of view stays; the horizontal one changes."""
    factor = height / views.height
    Ks = views.Ks.double() * factor
    Ks[:, 0, 2] = width / 2 + (views.Ks[:, 0, 2].double() - views.width / 2) * factor
    Ks[:, 2, 2] = 1.0
    return dataclasses.replace(views, Ks=Ks, width=width, height=height)


def _spread(views: Views, frames: int) -> Views:
    if len(views) == 0:
        raise DataError("a camera path needs views to go through; expected at least one")
    if frames < 1:
        raise DataError(f"a camera path of {frames} frames; expected at least 1")
    return views.spread(frames)


def _poses(views: Views) -> tuple[np.ndarray, np.ndarray]:
    """Positions (C, 3), and rotations (C, 3, 3) from camera to world, OpenCV axes, float64."""
    poses = invert_rigid(views.viewmats.detach().double().cpu())
    return poses[:, :3, 3].numpy(), poses[:, :3, :3].numpy()


def _viewmats(places: np.ndarray, turns: np.ndarray) -> Tensor:
    """The inverse of :func:`_poses`, (C, 4, 4)."""
    return invert_rigid(torch.from_numpy(np.concatenate([turns, places[:, :, None]], axis=2)))


def _posed(views: Views, viewmats: Tensor, place: np.ndarray, knots: list[int] | np.ndarray) -> Views:
    """Cameras (F, 4, 4) with the views' intrinsics, interpolated at the fractional indices ``place`` (F,)."""
    Ks = views.Ks.double().cpu()
    low = torch.from_numpy(np.floor(place)).long().clamp(0, len(views) - 1)
    share = torch.from_numpy(np.asarray(place) - low.numpy())[:, None, None]
    Ks = torch.lerp(Ks[low], Ks[(low + 1).clamp_max(len(views) - 1)], share)
    return dataclasses.replace(views, viewmats=viewmats, Ks=Ks)


def _lengths(places: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Length (C - 1,) from each view to the next."""
    way = np.linalg.norm(np.diff(places, axis=0), axis=1)
    trace = np.einsum("aij,aij->a", turns[1:], turns[:-1])
    return way / max(float(way.mean()) if len(way) else 0.0, 1e-300) + np.arccos(np.clip((trace - 1) / 2, -1, 1))


def _knots(lengths: np.ndarray, frames: int) -> np.ndarray:
    """Frame of each of C views, (C,) ascending from 0 to ``frames - 1``, by the lengths (C - 1,) between them."""
    count = len(lengths) + 1
    done = np.concatenate([[0.0], np.cumsum(lengths)])
    share = done / done[-1] if done[-1] > 0 else np.arange(count) / max(count - 1, 1)
    return np.arange(count) + np.round((frames - count) * share).astype(int)


def _smooth(knots: np.ndarray, values: np.ndarray, frames: int) -> np.ndarray:
    """Values (C, D) at the knots (C,) and in between, (F, D)."""
    from scipy.interpolate import PchipInterpolator

    return PchipInterpolator(knots, values)(np.arange(frames))


def _angles(directions: Tensor, up: Tensor) -> tuple[Tensor, Tensor]:
    """Yaw about ``up`` (3,) and pitch of directions (n, 3), radians, (n,) each."""
    right, ahead = level_directions(up, directions.new_tensor([0.0, math.pi / 2]))
    height = (directions @ up) / directions.norm(dim=1).clamp_min(1e-300)
    return torch.atan2(directions @ ahead, directions @ right), torch.asin(height.clamp(-1, 1))


def _upright(eyes: Tensor, angles: Tensor, up: Tensor) -> Tensor:
    """World-to-camera matrices (F, 4, 4) at ``eyes`` (F, 3), from yaw and pitch (F, 2) of :func:`_angles`."""
    yaw, pitch = angles.unbind(1)
    directions = pitch.cos()[:, None] * level_directions(up, yaw) + pitch.sin()[:, None] * up
    return look_at(eyes, eyes + directions, up)
