"""Samples views of a scene that comes without cameras: where people would stand, and what they would look at.

All is done in units of the content (its diagonal is 10), so that the scene's own unit does not matter.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, content_box, content_diagonal, in_units, positions_in_units, thinned
from pointsplat_ns.looking.poses import NEAR_PLANE, views_of
from pointsplat_ns.looking.search import DISTANCE, ENCLOSED, PLACES, TOO_NEAR, Search
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import photo_places
from pointsplat_ns.looking.upright import UprightBox, pointing_up, upright_axis
from pointsplat_ns.views import Views

PROBED = 5_000
"""Number of Gaussians, at most, of the depth images that test a view."""

_BLUR_PROBED = 40_000
"""Number of Gaussians, at most, of the pictures in which blur is measured. 5,000 of them are too few: large ones then
hide the others."""

_MOSTLY = 0.85
"""Least share of the free places of a room's box that are enclosed. Beside an object there are others."""

_AS_MUCH = 0.9
"""Least share of what is seen from outside that the enclosed places of a room see."""


@torch.no_grad()
def sample_views(
    scene: Gaussians, count: int, width: int = 320, height: int = 240, seed: int = 0, up: Tensor | None = None
) -> Views:
    """Sample cameras that look at a scene as people would.

    A scene that is seen whole from enclosed places in it is a room: cameras then stand in free space at the height of
    eyes and look about level. Any other is looked at from around. Of many such views, those are taken that show most of
    what the views before them have not shown, in the middle of the picture rather than at its edge; a small depth image
    tests that nothing is in the way. Ask for all the views at once that are wanted, as they then complete each other.

    Where the Gaussians say from where photos were taken (:mod:`pointsplat_ns.looking.traces`), half of the cameras
    stand about there and look at what photos showed.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1.
        width: of the images, pixels.
        height: of the images, pixels. The field of view is 70 degrees across the longer side.
        seed: the same scene and seed give the same views, another seed gives others.
        up: (3,) which way is up in the world, of any length; by default it is estimated from the scene
            (:mod:`pointsplat_ns.looking.upright`).

    Returns:
        ``count`` views, on the CPU, over black: ``viewmats`` (count, 4, 4) from world to camera in OpenCV axes and
        ``Ks`` (count, 3, 3) in pixels, float64, with a near plane that suits the scene's size. Fewer where the search
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
    return views_about(scene, photo_places(scene), count, width, height, seed, up)


@torch.no_grad()
def views_about(
    scene: Gaussians,
    photos: tuple[Tensor, Tensor] | None,
    count: int,
    width: int = 320,
    height: int = 240,
    seed: int = 0,
    up: Tensor | None = None,
    sharp: bool = True,
) -> Views:
    """As :func:`sample_views`, with what :func:`~pointsplat_ns.looking.traces.photo_places` says of the scene.

    Args:
        sharp: whether views that a few large Gaussians fill are left out, as nobody takes such photos. Renders are then
            compared where they matter; without it, views stand in more places.
    """
    if count < 1:
        raise DataError(f"{count} views asked for; expected at least 1")
    if min(width, height) < 1:
        raise DataError(f"views of {width} x {height} pixels asked for; expected at least 1 x 1")
    if up is not None:
        up = torch.as_tensor(up).detach().double().cpu()
        if up.shape != (3,) or not 0 < float(up.norm()) < math.inf:
            raise DataError(f"up is {up.tolist()}; expected three numbers, not all 0")
        up = up / up.norm()
    centre, diagonal, surface = _content_surface(scene)
    photos = _places_in_units(photos, centre, diagonal)
    box, inside = _upright(surface, photos, up)
    small = in_units(thinned(scene, PROBED), centre, diagonal)
    fine, sizes = None, None
    if sharp:
        fine = in_units(thinned(scene, _BLUR_PROBED), centre, diagonal)
        sizes = _widths(fine) / math.sqrt(max(1, len(scene) // _BLUR_PROBED))
    generator = torch.Generator().manual_seed(seed)

    def found(inside: bool, about: tuple[Tensor, Tensor] | None, count: int) -> Tensor:
        return Search(small, fine, sizes, surface, box, inside, width, height, generator, about).views(count)

    near_photos = found(inside, photos, count // 2) if photos is not None and count > 1 else torch.empty(0, 4, 4)
    others = found(inside, None, count - len(near_photos))
    if len(near_photos) + len(others) == 0:
        others = found(not inside, None, count)
    taken = _alternating(near_photos.double(), others)
    if len(taken) == 0:
        raise DataError(
            "no free place to look at the scene from was found; give a run whose data is at hand, which has poses"
        )
    rotation, translation = taken[:, :3, :3], taken[:, :3, 3]
    viewmats = taken.clone()
    viewmats[:, :3, 3] = translation * (diagonal / UNITS) - rotation @ centre
    return views_of(viewmats, width, height, NEAR_PLANE * diagonal)


def _alternating(first: Tensor, second: Tensor) -> Tensor:
    """Matrices (n, 4, 4) and (m, 4, 4) in turn, (n + m, 4, 4), so that a few of them are of both kinds."""
    ranks = torch.cat([(torch.arange(len(some)) + 0.5) / max(1, len(some)) for some in (first, second)])
    return torch.cat([first, second])[ranks.argsort(stable=True)]


@torch.no_grad()
def estimated_up(scene: Gaussians) -> Tensor:
    """Which way is up in a scene, (3,) float64 of length 1, as :func:`sample_views` takes it.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    return _stood_up(scene, photo_places(scene))[0].up


@torch.no_grad()
def is_room(scene: Gaussians) -> bool:
    """Whether a scene that does not tell where its photos were taken is looked at from inside.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    return _stood_up(scene, None)[1]


def _stood_up(scene: Gaussians, photos: tuple[Tensor, Tensor] | None) -> tuple[UprightBox, bool]:
    """As :func:`_upright`, of a scene and places in its own unit."""
    centre, diagonal, surface = _content_surface(scene)
    return _upright(surface, _places_in_units(photos, centre, diagonal))


def _places_in_units(
    photos: tuple[Tensor, Tensor] | None, centre: Tensor, diagonal: float
) -> tuple[Tensor, Tensor] | None:
    """Places of photos and their shares, in units of the content."""
    return None if photos is None else (positions_in_units(photos[0], centre, diagonal), photos[1])


def _content_surface(scene: Gaussians) -> tuple[Tensor, float, Surface]:
    """Centre (3,) and diagonal of the content, and its surface in units of it."""
    low, high = content_box(scene)
    diagonal = content_diagonal(scene, low, high)
    centre = 0.5 * (low + high).cpu()
    return centre, diagonal, Surface.of(scene, centre, diagonal)


def _upright(
    surface: Surface, photos: tuple[Tensor, Tensor] | None, up: Tensor | None = None
) -> tuple[UprightBox, bool]:
    """The upright box of a scene, by the direction ``up`` (3,) if it is known, and whether the scene is a room."""
    axis = upright_axis(surface, photos) if up is None else up
    inside = _is_room(surface, UprightBox.of(surface, axis))
    return UprightBox.of(surface, pointing_up(surface, axis, inside) if up is None else up), inside


def _widths(scene: Gaussians) -> Tensor:
    """Geometric means (N,) of the two larger standard deviations of Gaussians, float64; finite."""
    logs = scene.scales.double().sort(dim=1).values[:, 1:].mean(1)
    return logs.clamp(-100.0, 100.0).nan_to_num(-100.0).exp()


def _is_room(surface: Surface, box: UprightBox) -> bool:
    """Whether the scene is one to look at from inside."""
    generator = torch.Generator().manual_seed(0)
    places = box.places(4 * PLACES, generator)
    places = places[surface.clearance(places) > TOO_NEAR][:PLACES]
    if len(places) == 0:
        return False
    seen, around = surface.seen_from(places)
    enclosed = around >= ENCLOSED
    if float(enclosed.float().mean()) < _MOSTLY:
        return False
    outside = torch.randn(PLACES, 3, generator=generator, dtype=torch.float64)
    outside = outside / outside.norm(dim=1, keepdim=True) * DISTANCE[1]
    from_inside, from_outside = (some.any(0).float().mean() for some in (seen[enclosed], surface.seen_from(outside)[0]))
    return float(from_inside) >= _AS_MUCH * float(from_outside)
