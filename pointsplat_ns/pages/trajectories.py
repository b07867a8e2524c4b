"""Camera paths from views of a scene: exactly through them, a walk past them, an orbit about their content."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.looking.upright import level_directions
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.system.tensors import DOUBLES
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


def walk(views: Views, frames: int, up: Tensor | None = None, from_first: bool = False) -> Views:
    """A smooth, upright walk of ``frames`` cameras (float64) past at most 12 of the views, evenly spread, in a short
    order. Cameras do not roll.

    ``up`` (3,) has length 1; by default it is that of the views. With ``from_first`` it begins at the first of the
    views, not where the walk is shortest. Raises DataError if there is no view, or ``frames`` is not positive.
    """
    views = _spread(views.spread(VIEW_COUNTS.walked), frames)
    places, turns = _poses(views)
    order = _tour(_distances(places, turns), [0] if from_first else range(len(views)))
    views, places, turns = views[order], places[order], turns[order]
    knots = _knots(_lengths(places, turns), frames)
    up = up_of(views) if up is None else up
    yaw, pitch = _angles(torch.from_numpy(turns[:, :, 2]), up)
    angles = np.stack([np.unwrap(yaw.numpy()), pitch.numpy()], axis=1)
    angles = angles.repeat(frames, axis=0) if len(views) == 1 else _smooth(knots, angles, frames)
    eyes = places.repeat(frames, axis=0) if len(views) == 1 else _smooth(knots, places, frames)
    viewmats = _upright(torch.from_numpy(eyes), torch.from_numpy(angles), up)
    return _posed(views, viewmats, np.interp(np.arange(frames), knots, range(len(knots))), knots)


def orbit(views: Views, frames: int, centre: Tensor, up: Tensor | None = None) -> Views:
    """A closed orbit of ``frames`` cameras (float64) about the common focus of views, at their median distance and
    height.

    Where a side has no views, the path swings to and fro over the other sides. In a room, where views look away from
    each other, the camera turns on the spot. ``centre`` (3,) of the scene's content is for views without a common
    focus; ``up`` (3,) has length 1, and is by default that of the views. Raises DataError if there is no view, or
    ``frames`` is not positive.
    """
    _check(views, frames)
    places, turns = (torch.from_numpy(values) for values in _poses(views))
    ahead, up = turns[:, :, 2], up_of(views) if up is None else up
    focus = _focus(places, ahead, centre.double())
    time = 2 * math.pi * torch.arange(frames, **DOUBLES) / frames
    still = np.zeros(frames)
    if float((((focus - places) * ahead).sum(1) > 0).double().mean()) < 0.7:
        nearest = int((places - focus).norm(dim=1).argmin())
        yaw, pitch = _angles(ahead, up)
        angles = torch.stack([yaw[nearest] + time, pitch.median().expand(frames)], dim=1)
        return _posed(views, _upright(places[nearest].expand(frames, 3), angles, up), still, [0])
    apart = places - focus
    height = apart @ up
    level = (apart - height[:, None] * up).norm(dim=1).median()
    turn = _swing(_angles(apart, up)[0], time)
    eyes = focus + level * level_directions(up, turn) + height.median() * up
    return _posed(views, look_at(eyes, focus.expand(frames, 3), up), still, [0])


def up_of(views: Views) -> Tensor:
    """The up direction of cameras that are held level, (3,) float64 of length 1.

    It is the direction most nearly perpendicular to their horizontal axes; where these are all alike, the mean of the
    cameras' own up directions.
    """
    turns = torch.from_numpy(_poses(views)[1])
    right, up = turns[:, :, 0], -turns[:, :, 1].mean(0)
    sizes, directions = torch.linalg.eigh(right.T @ right / len(right))
    if float(sizes[1] - sizes[0]) > 0.01:  # a smaller difference does not determine the axis
        up = directions[:, 0] * torch.sign(directions[:, 0] @ up)
    return up / up.norm().clamp_min(1e-300)


def fitted(views: Views, width: int, height: int) -> Views:
    """The same cameras with pictures of another size. The vertical field of view stays; the horizontal one changes."""
    factor = height / views.height
    Ks = views.Ks.double() * factor
    Ks[:, 0, 2] = width / 2 + (views.Ks[:, 0, 2].double() - views.width / 2) * factor
    Ks[:, 2, 2] = 1.0
    return dataclasses.replace(views, Ks=Ks, width=width, height=height)


def _check(views: Views, frames: int) -> None:
    if len(views) == 0:
        raise DataError("a camera path needs views to go through; expected at least one")
    if frames < 1:
        raise DataError(f"a camera path of {frames} frames; expected at least 1")


def _spread(views: Views, frames: int) -> Views:
    _check(views, frames)
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


def _distances(places: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Distances between views (C, C): distance of positions over its mean, plus the angle in radians."""
    way = np.linalg.norm(places[:, None] - places[None], axis=2)
    trace = np.einsum("aij,bij->ab", turns, turns)
    return way / max(float(way.mean()), 1e-300) + np.arccos(np.clip((trace - 1) / 2, -1, 1))


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


def _tour(distances: np.ndarray, starts: Iterable[int]) -> list[int]:
    """A short order of views by their distances (C, C): from the best of ``starts``, always to the nearest remaining
    view."""

    def from_start(start: int) -> tuple[float, list[int]]:
        order, total = [start], 0.0
        left = set(range(len(distances))) - {start}
        while left:
            nearest = min(left, key=lambda other: (distances[order[-1], other], other))
            total += distances[order[-1], nearest]
            left.remove(nearest)
            order.append(nearest)
        return total, order

    return min(from_start(start) for start in starts)[1]


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


def _focus(places: Tensor, ahead: Tensor, centre: Tensor) -> Tensor:
    """The point (3,) nearest to the optical axes of cameras, with a small pull to ``centre``."""
    across = torch.eye(3, **DOUBLES) - ahead[:, :, None] * ahead[:, None]
    pull = 0.02 * len(places) * torch.eye(3, **DOUBLES)  # decides where all cameras look the same way
    return torch.linalg.solve(across.sum(0) + pull, (across @ places[:, :, None]).sum(0)[:, 0] + pull @ centre)


def _swing(sides: Tensor, time: Tensor) -> Tensor:
    """Angles (F,) at times (F,) from 0 to 2 pi: a full turn, or to and fro over the views' angles ``sides`` (n,)."""
    sides = sides.sort().values
    gaps = torch.cat([sides[1:] - sides[:-1], sides[:1] + 2 * math.pi - sides[-1:]])
    widest = int(gaps.argmax())
    if float(gaps[widest]) < math.radians(100):  # no views there: not crossed
        return sides[0] + time
    arc = 2 * math.pi - float(gaps[widest])
    return sides[(widest + 1) % len(sides)] + arc * 0.5 * (1 + time.sin())
