"""From where a scene is looked at, and how large a Gaussian is in a picture from there.

The error that counts is per solid angle, not per squared metre: a far wall of large Gaussians covers a smaller part of
a picture than a table in the middle of the room. Here occlusion is not considered;
:mod:`~pointsplat_ns.pruning.merging.visibility` counts it.

All positions are in units of the content, see :func:`~pointsplat_ns.looking.content.in_units`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.cameras import invert_rigid
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.sampling import views_about
from pointsplat_ns.looking.traces import photo_places
from pointsplat_ns.pruning.merging.settings import DEFAULTS, MergeSettings
from pointsplat_ns.views import View, Views


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """From where a scene is looked at."""

    views: Views
    given: bool
    """Whether the views were given, and not sampled."""
    photos: tuple[Tensor, Tensor] | None = None
    """Places (P, 3) where photos were taken and their shares (P,), as far as the scene tells; None if it does not, or
    if views were given."""


def sampled_viewpoints(scene: Gaussians, width: int, height: int, settings: MergeSettings) -> Viewpoints | None:
    """Views from where photos were taken if the scene tells, else from free places in it.

    Args:
        scene: N Gaussians.
        width, height: size of the pictures, pixels.
        settings: ``sampled_views``, ``view_seed`` and ``find_photo_places``.

    Returns:
        The viewpoints; None if no place in the scene is free, or no view is asked for.
    """
    photos = photo_places(scene) if settings.find_photo_places else None
    try:
        views = views_about(scene, photos, settings.sampled_views, width, height, seed=settings.view_seed, sharp=False)
    except DataError:
        return None
    return Viewpoints(views, given=False, photos=photos)


def view_weights(means: Tensor, views: Views, outside_weight: float, settings: MergeSettings) -> Tensor:
    """Mean over views of 1 / distance^2, (N,) float32: the pixels of a unit of area, up to a common factor.

    Args:
        means: (N, 3) positions.
        views: C views.
        outside_weight: factor for views whose picture a position is outside of. At 1 only the places of the cameras
            count, and not their directions: a viewer who stands there may turn round.
        settings: ``min_distance`` and ``picture_margin``.
    """
    eyes = invert_rigid(views.viewmats.double())[:, :3, 3].to(means)
    total = torch.zeros(len(means), dtype=torch.float32)
    for eye, view in zip(eyes, views, strict=True):
        weight = place_weight(means, eye, settings)
        if outside_weight != 1:
            weight = weight.where(in_picture(means, view, settings.picture_margin), outside_weight * weight)
        total += weight
    return total / len(eyes)


def place_weights(means: Tensor, places: Tensor, shares: Tensor, settings: MergeSettings) -> Tensor:
    """As :func:`view_weights`, from places (P, 3) that count by their shares (P,), in all directions."""
    total = torch.zeros(len(means), dtype=torch.float32)
    for place, share in zip(places.to(means), shares.tolist(), strict=True):
        total += share * place_weight(means, place, settings)
    return total


def place_weight(means: Tensor, eye: Tensor, settings: MergeSettings) -> Tensor:
    """1 / (distance^2 + d^2) from a place (3,) to positions (N, 3), (N,) float32, with d of ``min_distance``."""
    return 1 / ((means - eye).square().sum(1) + (settings.min_distance * UNITS) ** 2).float()


def in_picture(means: Tensor, view: View, margin: float = DEFAULTS.picture_margin) -> Tensor:
    """Whether positions (N, 3), in the unit of the view, are in front of a camera and in its picture, (N,) bool.

    Args:
        margin: how far outside of the picture still counts, as a share of its width and height.
    """
    viewmat, K = view.viewmat.to(means), view.K.to(means)
    at = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = at[:, 2:]
    # Multiplied by the depth, so that nothing is divided by it.
    size = at.new_tensor([view.width, view.height])
    place = at[:, :2] * K.diagonal()[:2] + (K[:2, 2] - 0.5 * size) * depth
    return ((depth > 0) & (place.abs() <= (0.5 + margin) * size * depth)).all(1)
