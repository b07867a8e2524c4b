"""Samples views of a scene that comes without cameras: from where people would stand, towards what they would look at.

All is in units of the content (its diagonal is 10), so that the scene's own unit does not matter.
"""

from __future__ import annotations

import math
from functools import cached_property

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, content_box, content_size, in_units, thinned
from pointsplat_ns.looking.poses import views_of
from pointsplat_ns.looking.search import ViewSearch
from pointsplat_ns.looking.settings import LOOKING, LookingSettings
from pointsplat_ns.looking.sizes import RESOLUTION
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import PhotoPlaces, log_widths, photo_places
from pointsplat_ns.looking.upright import Up, UprightBox, known_up, pointing_up, upright_axis
from pointsplat_ns.looking.whole import seen_from_above
from pointsplat_ns.system.tensors import DOUBLES, FLOATS
from pointsplat_ns.views import Views


@torch.no_grad()
def sample_views(
    scene: Gaussians,
    count: int,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    up: Tensor | None = None,
    settings: LookingSettings = LOOKING,
) -> Views:
    """Sample cameras that look at a scene as people would.

    A scene whose points are visible from enclosed places in it is a room: cameras stand in free space at the height of
    eyes and look about level. In other scenes, cameras stand around the content as well. Of many candidates, the next
    view is the one with the largest coverage gain: it shows points that earlier views have not shown, in the middle of
    the picture rather than at its edge. Views complete each
    other, so ask for all of them at once.

    If the Gaussians have traces of where photos were taken (:mod:`pointsplat_ns.looking.traces`), half of the cameras
    stand near these places and look at the parts that photos showed.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1.
        width: of the images, pixels.
        height: of the images, pixels. The field of view is 70 degrees across the longer side.
        seed: the same scene and seed give the same views, another seed gives others.
        up: (3,) direction that is up in the world, of any length; by default the scene's own, or estimated
            (:mod:`pointsplat_ns.looking.upright`).
        settings: tuned numbers, see :mod:`pointsplat_ns.looking.settings`.

    Returns:
        ``count`` views, on the CPU, over black: ``viewmats`` (count, 4, 4) from world to camera in OpenCV axes and
        ``Ks`` (count, 3, 3) in pixels, float64, with a near plane that suits the scene's size. Fewer if the search
        finds fewer.

    Raises:
        DataError: if ``count`` or the size is not positive, ``up`` is not a direction, nothing of the scene is visible,
            or no free position is found.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 3, width=64, height=48)
        >>> len(views), tuple(views.viewmats.shape), (views.width, views.height)
        (3, (3, 4, 4), (64, 48))
    """
    return Sampler(scene, (width, height), None if up is None else Up(unit_direction(up)), settings).views(count, seed)


class Sampler:
    """Samples views of a scene as :func:`sample_views` does. What all views have in common is found once.

    Args:
        scene: N Gaussians. A large one is thinned.
        resolution: width and height of the views, pixels.
        up: which way is up; by default the axis that the scene declares, or estimated.
        settings: tuned numbers, see :mod:`pointsplat_ns.looking.settings`.

    Raises:
        DataError: if the resolution is not positive.
    """

    def __init__(
        self,
        scene: Gaussians,
        resolution: tuple[int, int] = RESOLUTION,
        up: Up | None = None,
        settings: LookingSettings = LOOKING,
    ):
        if min(resolution) < 1:
            raise DataError(f"views of {resolution[0]} x {resolution[1]} pixels asked for; expected at least 1 x 1")
        self.scene = thinned(scene.detach(), settings.sampled_count).to("cpu")  # many small operations
        self._count = len(scene)
        self.resolution, self.settings, self._up = resolution, settings, known_up(up, scene)

    @cached_property
    def photos(self) -> PhotoPlaces | None:
        """Where the scene's photos were taken, scene units; None if it does not tell."""
        return photo_places(self.scene, self.settings)

    @cached_property
    def content(self) -> tuple[Tensor, float]:
        """Centre (3,) and diagonal of the content, scene units."""
        return content_size(self.scene, content_box(self.scene, self.settings))

    @cached_property
    def surface(self) -> Surface:
        """The surface of the content, in its units. Raises DataError if nothing is visible."""
        return Surface.of(self.scene, *self.content, self.settings)

    @cached_property
    def photos_in_units(self) -> PhotoPlaces | None:
        """:attr:`photos` in units of the content."""
        return None if self.photos is None else self.photos.in_units(*self.content)

    @cached_property
    def up(self) -> Up:
        """Which way is up. Raises DataError if it has to be estimated, and nothing of the scene is visible."""
        if self._up is not None:
            return self._up
        axis = upright_axis(self.surface, self.photos_in_units)
        return pointing_up(self.surface, axis, seen_from_above(self.scene, *self.content, self.surface, axis))

    @cached_property
    def box(self) -> UprightBox:
        """The upright box around the surface."""
        return UprightBox.of(self.surface, self.up.direction)

    @cached_property
    def inside(self) -> bool:
        """Whether the scene is one to look at from inside."""
        return is_room(self.surface, self.box)

    @cached_property
    def _fine(self) -> tuple[Gaussians, Tensor]:
        """Some of the Gaussians, enlarged, in units of the content, and their widths (n,) before they were enlarged."""
        count = self.settings.blur_count
        fine = in_units(thinned(self.scene, count), *self.content)
        widths = log_widths(fine.scales).nan_to_num(-100.0).exp()
        return fine, widths / math.sqrt(max(1, self._count // count))

    @torch.no_grad()
    def views(self, count: int, seed: int = 0, sharp: bool = True, about_photos: bool = True) -> Views:
        """``count`` views on the CPU, fewer if the search finds fewer.

        Args:
            count, seed: as for :func:`sample_views`.
            sharp: whether blurred views are refused, which a few large Gaussians fill, because nobody takes such
                photos. Renders are then compared where they matter; without the rule, views stand in more places.
            about_photos: whether half of the views stand near places of photos, if the scene tells them.

        Raises:
            DataError: as :func:`sample_views`.
        """
        if count < 1:
            raise DataError(f"{count} views asked for; expected at least 1")
        generator = torch.Generator().manual_seed(seed)
        fine, widths = self._fine if sharp else (None, None)

        def found(inside: bool, photos: PhotoPlaces | None, count: int) -> Tensor:
            pictures = (inside, *self.resolution)
            search = ViewSearch(fine, widths, self.surface, self.box, *pictures, generator, photos, self.settings)
            return search.views(count)

        near_photos = torch.empty(0, 4, 4, **DOUBLES)
        if about_photos and self.photos_in_units is not None:
            near_photos = found(self.inside, self.photos_in_units, int(self.settings.photo_share * count))
        others = found(self.inside, None, count - len(near_photos))
        if len(near_photos) + len(others) == 0:
            others = found(not self.inside, None, count)
        taken = _alternating(near_photos, others)
        if len(taken) == 0:
            raise DataError(
                "no free place to look at the scene from was found; give a run whose data is at hand, which has poses"
            )
        return views_in_scene_units(taken, *self.resolution, *self.content, self.settings)


def unit_direction(up: Tensor) -> Tensor:
    """A direction (3,) of any length, at a length of 1, float64, on the CPU.

    Raises:
        DataError: if it is not a direction.
    """
    up = torch.as_tensor(up, **DOUBLES).detach()
    if up.shape != (3,) or not 0 < float(up.norm()) < math.inf:
        raise DataError(f"up is {up.tolist()}; expected three numbers, not all 0")
    return up / up.norm()


def views_in_scene_units(
    viewmats: Tensor, width: int, height: int, centre: Tensor, diagonal: float, settings: LookingSettings = LOOKING
) -> Views:
    """Views of a scene from world-to-camera matrices (C, 4, 4) in units of its content, which has this centre (3,) and
    diagonal, scene units."""
    moved = viewmats.clone()
    moved[:, :3, 3] = viewmats[:, :3, 3] * (diagonal / UNITS) - viewmats[:, :3, :3] @ centre
    return views_of(moved, width, height, diagonal, settings)


def _alternating(first: Tensor, second: Tensor) -> Tensor:
    """Matrices (n, 4, 4) and (m, 4, 4), evenly mixed, (n + m, 4, 4): a few of them contain both kinds."""
    ranks = torch.cat([(torch.arange(len(some), **FLOATS) + 0.5) / max(1, len(some)) for some in (first, second)])
    return torch.cat([first, second])[ranks.argsort(stable=True)]


def is_room(surface: Surface, box: UprightBox) -> bool:
    """Whether a scene is one to look at from inside: most of its free places are enclosed, and nearly all points that
    are visible from outside are visible from them as well."""
    settings = surface.settings
    generator = torch.Generator().manual_seed(0)
    places = box.places(settings.box_draws * settings.places, generator)
    places = places[surface.clearance(places) > settings.min_clearance][: settings.places]
    if len(places) == 0:
        return False
    visible, enclosure = surface.visible_from(places)
    enclosed = enclosure >= settings.min_enclosure
    if float(enclosed.float().mean()) < settings.min_enclosed_places:
        return False
    outside = torch.randn(settings.places, 3, generator=generator, **DOUBLES)
    outside = outside / outside.norm(dim=1, keepdim=True) * settings.distances[1]
    from_inside, from_outside = (
        float(some.any(0).float().mean()) for some in (visible[enclosed], surface.visible_from(outside)[0])
    )
    return from_inside >= settings.min_visible_inside * from_outside
