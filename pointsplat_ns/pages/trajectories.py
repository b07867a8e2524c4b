"""Camera paths from views of a scene: smooth, and exactly through them."""

from __future__ import annotations

import dataclasses

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import invert_rigid
from pointsplat_ns.looking.poses import look_at
from pointsplat_ns.views import Views


def along(views: Views, frames: int, up: Tensor | None = None) -> Views:
    """A smooth path exactly through views, in their order, each of which is one of its ``frames`` cameras (float64);
    some views are left out if there are more.

    Positions are interpolated without overshoot (PCHIP), rotations with continuous acceleration (a spline of
    rotations). With ``up`` (3,), cameras between the views do not roll about it. The time between two views is
    proportional to their distance plus their angle. Raises DataError if there is no view, or ``frames`` is not
    positive.
    """
    if len(views) == 0:
        raise DataError("a camera path needs views to go through; expected at least one")
    if frames < 1:
        raise DataError(f"a camera path of {frames} frames; expected at least 1")
    views = views.spread(frames)
    own, Ks = views.viewmats.detach().double().cpu(), views.Ks.double().cpu()
    if len(views) == 1:
        return dataclasses.replace(views, viewmats=own.repeat(frames, 1, 1), Ks=Ks.repeat(frames, 1, 1))
    from scipy.interpolate import PchipInterpolator
    from scipy.spatial.transform import Rotation, RotationSpline

    poses = _poses(views)
    done = np.cumsum([0.0, *_distances(poses[:-1], poses[1:])])
    share = done / done[-1] if done[-1] > 0 else np.arange(len(views)) / (len(views) - 1)
    knots = np.arange(len(views)) + np.round((frames - len(views)) * share).astype(int)  # the frame of each view
    eyes = torch.from_numpy(PchipInterpolator(knots, poses[:, :3, 3])(np.arange(frames)))
    spline = RotationSpline(knots, Rotation.from_matrix(poses[:, :3, :3]))
    rotations = torch.from_numpy(spline(np.arange(frames)).as_matrix())
    if up is None:
        viewmats = invert_rigid(torch.cat([rotations, eyes[:, :, None]], dim=2))
    else:
        viewmats = look_at(eyes, eyes + rotations[:, :, 2], up)
    viewmats[knots] = own  # to the bit
    place = np.interp(np.arange(frames), knots, range(len(views)))
    low = torch.from_numpy(np.floor(place)).long()
    high, part = (low + 1).clamp_max(len(views) - 1), torch.from_numpy(place)[:, None, None] - low[:, None, None]
    Ks = torch.lerp(Ks[low], Ks[high], part)
    return dataclasses.replace(views, viewmats=viewmats, Ks=Ks)


def toured(views: Views) -> Views:
    """Views in a short order: from the first one always to the nearest of those that are left."""
    poses = _poses(views)
    distances = _distances(poses[:, None], poses[None])
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


def _poses(views: Views) -> np.ndarray:
    """From camera to world (C, 4, 4), OpenCV axes, float64."""
    return invert_rigid(views.viewmats.detach().double().cpu()).numpy()


def _distances(poses: np.ndarray, others: np.ndarray) -> np.ndarray:
    """From poses (..., 4, 4) to others: the distance of their positions over its mean, plus the angle in radians."""
    way = np.linalg.norm(others[..., :3, 3] - poses[..., :3, 3], axis=-1)
    trace = (others[..., :3, :3] * poses[..., :3, :3]).sum((-1, -2))
    return way / max(float(way.mean()), 1e-300) + np.arccos(np.clip((trace - 1) / 2, -1, 1))
