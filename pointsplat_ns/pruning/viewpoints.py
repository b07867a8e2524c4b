"""Where a scene is looked at from, if nobody says: free places in it, and how large things are from there.

The error that counts is per solid angle, not per square metre. A far wall of large Gaussians covers a smaller part of
images than a table in the middle of the room.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.cameras import invert_rigid
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.sampling import views_about
from pointsplat_ns.views import View, Views

VIEWPOINTS = 48
"""Number of views that a scene is looked at from. The first that are found are those that show most: in a lounge that
does not tell where photos were taken, 48 gain 0.3 dB over 16 in held-out poses (10 %), 96 no more."""

NEAREST = 0.1
"""Added in quadrature to distances, as a share of the content's diagonal: eyes are seldom closer, and a view that is
near a place by chance must not outweigh all others there."""

NOT_SHOWN = 1e-5
"""``not_shown`` of :func:`weights_seen` for the poses of photos. What no photo shows has never been trained: a quarter
of a scene was seen to be such Gaussians, left as they were at the start. On that scene (fox, 30 % kept) 0.02 gave 29.9
dB in held-out views, 1e-3 30.6, 1e-5 30.9."""

EDGE = 0.05
"""How far outside of a picture its content is counted as shown, as a share of its width and height."""

SEED = 1


def viewpoints(scene: Gaussians, photos: tuple[Tensor, Tensor] | None, width: int, height: int) -> Views | None:
    """Views from free places in a scene in units of its content, see :func:`~pointsplat_ns.looking.content.in_units`;
    None if there are none. ``photos`` is what :func:`~pointsplat_ns.looking.traces.photo_places` says of the scene."""
    try:
        return views_about(scene, photos, VIEWPOINTS, width, height, seed=SEED, sharp=False)
    except DataError:
        return None


def weights_seen(means: Tensor, views: Views, not_shown: float = 1.0) -> Tensor:
    """Mean over views of 1 / distance^2, (N,) float32: how large a unit of area at each position is in them.

    Args:
        means: (N, 3) positions, in units of the content.
        views: where they are looked at from.
        not_shown: factor for the views that do not show a position. At 1 only the places of the views matter, and not
            where they look: somebody who stands there may turn round.
    """
    eyes = invert_rigid(views.viewmats.double())[:, :3, 3].to(means)
    total = torch.zeros(len(means), dtype=torch.float32)
    for eye, view in zip(eyes, views, strict=True):
        size = _size_seen(means, eye)
        total += size if not_shown == 1 else size.where(in_picture(means, view), not_shown * size)
    return total / len(eyes)


def weights_seen_from(means: Tensor, places: Tensor, shares: Tensor) -> Tensor:
    """As :func:`weights_seen`, from places (P, 3) that count by their shares (P,)."""
    total = torch.zeros(len(means), dtype=torch.float32)
    for place, share in zip(places.to(means), shares.tolist(), strict=True):
        total += share * _size_seen(means, place)
    return total


def _size_seen(means: Tensor, eye: Tensor) -> Tensor:
    """How large a unit of area at each position (N, 3) is from a place (3,), (N,) float32."""
    return 1 / ((means - eye).square().sum(1) + (NEAREST * UNITS) ** 2).float()


def in_picture(means: Tensor, view: View) -> Tensor:
    """Whether each position (N, 3) is in front of a camera and in its picture or close to its edge, (N,)."""
    viewmat, K = view.viewmat.to(means), view.K.to(means)
    at = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = at[:, 2:]
    # Multiplied by the depth, so that nothing is divided by it.
    size = at.new_tensor([view.width, view.height])
    place = at[:, :2] * K.diagonal()[:2] + (K[:2, 2] - 0.5 * size) * depth
    return ((depth > 0) & (place.abs() <= (0.5 + EDGE) * size * depth)).all(1)
