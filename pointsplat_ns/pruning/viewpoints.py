"""Where a scene is looked at from, if nobody says: free places in it, and how large things are from there.

The error that counts is per solid angle, not per square metre. A far wall of large Gaussians covers a smaller part of
images than a table in the middle of the room.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.cameras import invert_rigid
from pointsplat_ns.pruning.view_sampling import content_box, sample_views
from pointsplat_ns.views import Views

VIEWPOINTS = 16
"""Number of views that a scene is looked at from."""

NEAREST = 0.1
"""Added in quadrature to distances, as a share of the content's diagonal: eyes are seldom closer, and a view that is
near a place by chance must not outweigh all others there."""

PROBED = 5_000
"""Number of Gaussians, at most, that free places are found with."""

UNITS = 10.0
"""Diagonal of the content after :func:`in_units`: all sizes that rendering knows, as that of its near plane, are small
against it."""

SEED = 1


def content_size(scene: Gaussians) -> tuple[Tensor, float]:
    """Centre (3,) float64 and diagonal of the box that holds most of a scene's opacity; of the largest Gaussian if that
    box is a point; 1 if that is a point as well."""
    try:
        low, high = content_box(scene)
    except DataError:  # nothing can be seen
        return torch.zeros(3, dtype=torch.float64), 1.0
    size = float((high - low).norm())
    if size == 0:
        size = float(scene.stds[scene.usable()].double().amax())
    return 0.5 * (low + high).cpu(), size if 0 < size < math.inf else 1.0


def in_units(scene: Gaussians, centre: Tensor, size: float) -> Gaussians:
    """A scene moved and scaled so that its content has its centre at 0 and a diagonal of :data:`UNITS`."""
    means = ((scene.means.double() - centre.to(scene.device)) * (UNITS / size)).to(scene.dtype)
    return scene.replace(means=means, scales=scene.scales + math.log(UNITS / size))


def thinned(scene: Gaussians, most: int) -> Gaussians:
    """At most about ``most`` Gaussians, evenly taken, grown so that they cover as much as all; without colours."""
    step = max(1, len(scene) // most)
    some = Gaussians(*(value[::step] for value in scene.tensors()))
    return some.replace(scales=some.scales + 0.5 * math.log(step), features_rest=some.features_rest[:, :0])


def viewpoints(scene: Gaussians, width: int, height: int) -> Views | None:
    """Views from free places in a scene in units of its content (:func:`in_units`); None if there are none."""
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
