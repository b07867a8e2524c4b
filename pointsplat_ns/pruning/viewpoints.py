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
from pointsplat_ns.pruning.content import UNITS, thinned
from pointsplat_ns.pruning.view_sampling import PROBED, sample_views
from pointsplat_ns.views import Views

VIEWPOINTS = 16
"""Number of views that a scene is looked at from."""

NEAREST = 0.1
"""Added in quadrature to distances, as a share of the content's diagonal: eyes are seldom closer, and a view that is
near a place by chance must not outweigh all others there."""

SEED = 1


def viewpoints(scene: Gaussians, width: int, height: int) -> Views | None:
    """Views from free places in a scene in units of its content, see :func:`~pointsplat_ns.pruning.content.in_units`;
    None if there are none."""
    try:
        return sample_views(thinned(scene, PROBED), VIEWPOINTS, width, height, seed=SEED)
    except DataError:
        return None


def weights_seen(means: Tensor, views: Views) -> Tensor:
    """Mean of 1 / distance^2 over views, (N,) float32: how large a unit of area at each position is in them.

    Args:
        means: (N, 3) positions, in units of the content.
        views: where they are looked at from.
    """
    eyes = invert_rigid(views.viewmats.double())[:, :3, 3].to(means)
    total = torch.zeros(len(means), dtype=torch.float32)
    for eye in eyes:
        total += 1 / ((means - eye).square().sum(1) + (NEAREST * UNITS) ** 2).float()
    return total / len(eyes)
