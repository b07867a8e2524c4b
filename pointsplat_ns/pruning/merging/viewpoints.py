"""From where a scene is looked at: given views, or sampled ones."""

from __future__ import annotations

from dataclasses import dataclass

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.sampling import views_about
from pointsplat_ns.looking.traces import photo_places
from pointsplat_ns.pruning.merging.settings import MergeSettings
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Viewpoints:
    """From where a scene is looked at."""

    views: Views  # in units of the content, see :func:`~pointsplat_ns.looking.content.in_units`
    photos_found: bool = False
    """Whether views were sampled about where photos were taken, because the scene tells."""


def sampled_viewpoints(scene: Gaussians, width: int, height: int, settings: MergeSettings) -> Viewpoints | None:
    """Views from where photos were taken if the scene tells, and from free places in it.

    Args:
        scene: N Gaussians in units of the content.
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
    return Viewpoints(views, photos_found=photos is not None)
