"""Samples views of a scene that comes without cameras: such as people may have taken photos from.

All is in units of the content (its diagonal is 10), so that the scene's own unit does not matter.
"""

from __future__ import annotations

import math
from functools import cached_property

import torch
from torch import Tensor

from pointsplat_ns.comparing.sizes import RESOLUTION
from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.candidates import Candidates
from pointsplat_ns.looking.content import UNITS, content_box, content_size, in_scene_units, in_units, thinned, thinning
from pointsplat_ns.looking.poses import views_of
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import PhotoEvidence, PhotoPlaces, photo_places
from pointsplat_ns.looking.upright import Up, known_up, pointing_up, upright_axis
from pointsplat_ns.looking.whole import seen_from_above
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.views import Views


@torch.no_grad()
def sample_views(
    scene: Gaussians,
    count: int,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    up: Tensor | None = None,
) -> Views:
    """Sample cameras that look at a scene as people may have when they took its photos.

    Candidates look at Gaussians at random, from distances at which these are small, or from places where SH suggest
    that photos were taken. Of the likely ones (:mod:`pointsplat_ns.looking.candidates`), the next view is always the
    one that shows most of what earlier views do not show. Views complete each other, so ask for all of them at once.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1.
        width: of the images, pixels.
        height: of the images, pixels. The field of view is 70 degrees across the longer side.
        seed: the same scene and seed give the same views, another seed gives others.
        up: (3,) direction that is up in the world, of any length; by default the scene's own, or estimated
            (:mod:`pointsplat_ns.looking.upright`).

    Returns:
        ``count`` views, on the CPU, over black: ``viewmats`` (count, 4, 4) from world to camera in OpenCV axes and
        ``Ks`` (count, 3, 3) in pixels, float64, with a near plane that suits the scene's size.

    Raises:
        DataError: if ``count`` or the size is not positive, ``up`` is not a direction, or nothing of the scene is
            visible.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 3, width=64, height=48)
        >>> len(views), tuple(views.viewmats.shape), (views.width, views.height)
        (3, (3, 4, 4), (64, 48))
    """
    return Sampler(scene, (width, height), None if up is None else Up(unit_direction(up))).views(count, seed)


class Sampler:
    """Samples views of a scene as :func:`sample_views` does. What all views have in common is found once.

    Args:
        scene: N Gaussians. A large one is thinned.
        resolution: width and height of the views, pixels.
        up: which way is up; by default the axis that the scene declares, or estimated.

    Raises:
        DataError: if the resolution is not positive.
    """

    def __init__(
        self,
        scene: Gaussians,
        resolution: tuple[int, int] = RESOLUTION,
        up: Up | None = None,
    ):
        if min(resolution) < 1:
            raise DataError(f"views of {resolution[0]} x {resolution[1]} pixels asked for; expected at least 1 x 1")
        self.scene = thinned(scene.detach(), LOOKING.sampled_count).to("cpu")  # many small operations
        self._step = thinning(len(scene), LOOKING.sampled_count)
        self.resolution, self._up = resolution, known_up(up, scene)

    @cached_property
    def content(self) -> tuple[Tensor, float]:
        """Centre (3,) and diagonal of the content, scene units."""
        return content_size(self.scene, content_box(self.scene))

    @cached_property
    def _in_units(self) -> Gaussians:
        return in_units(self.scene, *self.content)

    @cached_property
    def surface(self) -> Surface:
        """The surface of the content, in its units. Raises DataError if nothing is visible."""
        return Surface.of(self.scene, *self.content)

    @cached_property
    def _traces(self) -> tuple[PhotoEvidence, PhotoPlaces | None]:
        generator = torch.Generator().manual_seed(0)
        evidence = PhotoEvidence.of(self._in_units, generator)
        return evidence, photo_places(evidence, generator)

    @property
    def photos(self) -> PhotoPlaces | None:
        """Where the scene's photos were taken, in units of the content; None if it does not tell."""
        places = self._traces[1]
        return places if places is not None and places.sure else None

    @cached_property
    def up(self) -> Up:
        """Which way is up. Raises DataError if it has to be estimated, and nothing of the scene is visible."""
        if self._up is not None:
            return self._up
        axis = upright_axis(self.surface, None if self.photos is None else self._traces[0])
        return pointing_up(self.surface, axis, seen_from_above(self.scene, *self.content, self.surface, axis))

    @cached_property
    def candidates(self) -> Candidates:
        """What views are drawn from and judged by. Raises DataError if nothing is visible."""
        evidence, places = self._traces
        return Candidates.of(self._in_units, self._step, evidence, places, self.up.direction, self.resolution)

    @torch.no_grad()
    def views(self, count: int, seed: int = 0, likeliest: bool = False) -> Views:
        """``count`` views on the CPU. ``count``, ``seed`` and errors are those of :func:`sample_views`. Views complete
        each other, or are the likeliest, which may show the same."""
        if count < 1:
            raise DataError(f"{count} views asked for; expected at least 1")
        viewmats = self.candidates.views(count, torch.Generator().manual_seed(seed), likeliest)
        return in_scene_units(views_of(viewmats, *self.resolution, UNITS), *self.content)


def unit_direction(up: Tensor) -> Tensor:
    """A direction (3,) of any length, at a length of 1, float64, on the CPU.

    Raises:
        DataError: if it is not a direction.
    """
    up = torch.as_tensor(up, **DOUBLES).detach()
    if up.shape != (3,) or not 0 < float(up.norm()) < math.inf:
        raise DataError(f"up is {up.tolist()}; expected three numbers, not all 0")
    return up / up.norm()
