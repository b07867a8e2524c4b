"""Samples views of a scene that comes without cameras: where people would stand, and what they would look at.

All is done in units of the content (its diagonal is 10), so that the scene's own unit does not matter.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, content_box, content_diagonal, in_units, positions_in_units, thinned
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import TELLING, explained, photo_places
from pointsplat_ns.looking.upright import UprightBox, level_directions, pointing_up, upright_axis
from pointsplat_ns.rasterizer import pixels_of, render_depth
from pointsplat_ns.views import Views

FIELD_OF_VIEW = 70.0
"""Field of view across the longer side of the image, degrees: that of a phone's main camera."""

BACKGROUND = (0.0, 0.0, 0.0)

NEAR_PLANE = 1e-3
"""Depth that sampled views start at, as a share of the diagonal of the content's box."""

PROBED = 5_000
"""Number of Gaussians, at most, of the depth images that test a view."""

_PROBE_SIDE = 32
"""Longer side, in pixels, of these images."""

_TOO_NEAR = 0.5
"""Distance, in units, below which a surface is too near to the camera."""

_PHOTO_TOO_NEAR = 0.1
"""The same where photos were taken: what they show may be a small part of the content, and was not too near."""

_PHOTOS_APART = 0.4
"""Standard deviation of candidates about the places of photos, units: how far these are from each other."""

_LIKE_PHOTOS = 0.6
"""Least worth of what a view shows, relative to that of the best tenth of the candidates."""

_NEAR_PIXELS = 0.05
"""Largest allowed share of pixels that show a surface that is too near."""

_BLURRED = 0.04
"""Largest median of what Gaussians subtend in a view, radians: the standard deviation of each over its distance, by its
share of the picture. From where nobody took photos, few large Gaussians fill the picture. In the photos of six captures
it is 0.009 to 0.026, in half of the views that are sampled there without this rule 0.04 to 0.5."""

_COARSE = 2.0
"""The same for scenes of few Gaussians: so many times what the median one subtends from half the content's diagonal."""

_BLUR_PROBED = 40_000
"""Number of Gaussians, at most, of the pictures in which that is measured. 5,000 of them are too few: large ones then
hide the others."""

_BLUR_SIDE = 64
"""Longer side of these pictures, pixels."""

_COVERED = {True: 0.7, False: 0.05}
"""Least mean alpha of the image. Inside it must show something nearly everywhere; an object may stand before
nothing."""

_ENCLOSED = 0.6
"""Least share of all directions in which there is a surface, for a place inside a room."""

_MOSTLY = 0.85
"""Least share of the free places of a room's box that are enclosed. Beside an object there are others."""

_AS_MUCH = 0.9
"""Least share of what is seen from outside that the enclosed places of a room see."""

_HEIGHTS = (0.3, 0.75)
"""Where eyes are between the floor and the ceiling of a room."""

_PITCH = (-10.0, 8.0, -30.0, 10.0)
"""Mean, standard deviation and bounds of how far up a camera in a room looks, degrees."""

_ELEVATION = (-5.0, 60.0)
"""How far above an object's middle it is looked at from, degrees."""

_ABOVE_GROUND = 0.05
"""Least height of a camera outside, as a share of the content's."""

_DISTANCE = (5.5, 9.5)
"""How far from an object's middle cameras are, units."""

_PLACES = 48
"""Number of places, at most, whose views compete for being taken."""

_TURNS = {True: 8, False: 4}
"""Number of views at each place, inside and outside."""

_ROUND = 16
"""Number of views, at most, that are taken before other places are drawn."""

_COMPARED = 4096
"""Number of points that views compete for."""

_FAR = 4.0
"""Distance, units, from which on a surface counts less, as it is then small in the image."""

_NOVEL = 0.1
"""Once a point has been shown this well (1 is in the middle of a picture and near), it counts half."""

_REFUSED = 32
"""A round ends after so many candidates in a row that something stands in front of; in trained scenes three were the
most."""

_FRUITLESS = 4
"""Rounds without any view after which the search ends."""

_SEARCHED = 2.0
"""A search ends with fewer views after so many times the rounds that it needs if nothing is refused, and two more."""


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
) -> Views:
    """As :func:`sample_views`, with what :func:`~pointsplat_ns.looking.traces.photo_places` says of the scene."""
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
    fine = in_units(thinned(scene, _BLUR_PROBED), centre, diagonal)
    sizes = _widths(fine) / math.sqrt(max(1, len(scene) // _BLUR_PROBED))
    generator = torch.Generator().manual_seed(seed)

    def found(inside: bool, about: tuple[Tensor, Tensor] | None, count: int) -> Tensor:
        return _Search(small, fine, sizes, surface, box, inside, width, height, generator, about).views(count)

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
    return _views(viewmats, width, height, NEAR_PLANE * diagonal)


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


def look_at(positions: Tensor, targets: Tensor, up: Tensor | None = None) -> Tensor:
    """World-to-camera matrices (C, 4, 4) of cameras at ``positions`` (C, 3) that look at ``targets`` (C, 3), with
    ``up`` (3,), by default z, up where that is possible; OpenCV axes."""
    forward = targets - positions
    length = forward.norm(dim=1, keepdim=True)
    ahead = forward.new_tensor([1.0, 0.0, 0.0]).expand_as(forward)
    forward = torch.where(length > 0, forward / length.clamp_min(1e-300), ahead)
    up = forward.new_tensor([0.0, 0.0, 1.0]) if up is None else up.to(forward) / up.to(forward).norm()
    other = torch.eye(3, dtype=forward.dtype)[int(up.abs().argmin())]
    steep = (forward @ up).abs() > 0.99
    right = torch.linalg.cross(forward, torch.where(steep[:, None], other, up))
    right = right / right.norm(dim=1, keepdim=True)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=1)  # (C, 3, 3) world to camera
    viewmats = torch.eye(4, dtype=positions.dtype).repeat(len(positions), 1, 1)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -(rotation @ positions[..., None])[..., 0]
    return viewmats


def _views(viewmats: Tensor, width: int, height: int, near_plane: float) -> Views:
    focal = 0.5 * max(width, height) / math.tan(math.radians(FIELD_OF_VIEW) / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=viewmats.dtype)
    Ks = K.repeat(len(viewmats), 1, 1)
    return Views(viewmats, Ks, width, height, torch.tensor(BACKGROUND), near_plane=near_plane)


def _widths(scene: Gaussians) -> Tensor:
    """Geometric means (N,) of the two larger standard deviations of Gaussians, float64; finite."""
    logs = scene.scales.double().sort(dim=1).values[:, 1:].mean(1)
    return logs.clamp(-100.0, 100.0).nan_to_num(-100.0).exp()


def _is_room(surface: Surface, box: UprightBox) -> bool:
    """Whether the scene is one to look at from inside."""
    generator = torch.Generator().manual_seed(0)
    places = box.places(4 * _PLACES, generator)
    places = places[surface.clearance(places) > _TOO_NEAR][:_PLACES]
    if len(places) == 0:
        return False
    seen, around = surface.seen_from(places)
    enclosed = around >= _ENCLOSED
    if float(enclosed.float().mean()) < _MOSTLY:
        return False
    outside = torch.randn(_PLACES, 3, generator=generator, dtype=torch.float64)
    outside = outside / outside.norm(dim=1, keepdim=True) * _DISTANCE[1]
    from_inside, from_outside = (some.any(0).float().mean() for some in (seen[enclosed], surface.seen_from(outside)[0]))
    return float(from_inside) >= _AS_MUCH * float(from_outside)


@dataclass
class _Search:
    """A search for views, all of it in units of the content."""

    small: Gaussians
    fine: Gaussians
    """More of the scene's Gaussians."""
    sizes: Tensor
    """Widths (n,) of the Gaussians of ``fine`` as they are in the scene."""
    surface: Surface
    box: UprightBox
    inside: bool
    width: int
    height: int
    generator: torch.Generator
    photos: tuple[Tensor, Tensor] | None
    """Places (P, 3) where photos were taken, and their shares (P,), if that is known."""
    most_blur: float = field(init=False)
    """Largest blur of a view, radians. It doubles with each round that finds too few views."""

    def __post_init__(self) -> None:
        self.most_blur = max(_BLURRED, _COARSE * float(self.sizes.median()) / (0.5 * UNITS))

    def views(self, count: int) -> Tensor:
        """At most ``count`` world-to-camera matrices (n, 4, 4)."""
        shown = torch.zeros(_COMPARED)
        taken: list[Tensor] = []
        wanted = torch.ones(_COMPARED) if self.photos is None else self.surface.shown[:_COMPARED]
        fruitless, rounds = 0, 0
        while len(taken) < count and fruitless < _FRUITLESS and rounds < 2 + _SEARCHED * math.ceil(count / _ROUND):
            rounds += 1
            viewmats, owner, gains = self._candidates()
            before, refused = len(taken), 0
            while len(taken) < min(count, before + _ROUND) and refused < _REFUSED and bool((owner >= 0).any()):
                best = int((gains @ (1 / (_NOVEL + shown))).masked_fill(owner < 0, -1.0).argmax())
                if self._is_free(viewmats[best]):
                    taken.append(viewmats[best])
                    shown += gains[best] / wanted
                    owner[owner == owner[best].item()] = -1  # one view a place
                    refused = 0
                else:
                    owner[best] = -1
                    refused += 1
            fruitless = 0 if len(taken) > before else fruitless + 1
            if len(taken) < min(count, before + _ROUND):  # rather blurred views than few places
                self.most_blur *= 2
        return torch.stack(taken) if taken else torch.empty(0, 4, 4, dtype=torch.float64)

    def _candidates(self) -> tuple[Tensor, Tensor, Tensor]:
        """Views (V, 4, 4) of some places, the place (V,) of each, and how much they show of each point (V, P)."""
        if self.photos is not None:
            return self._like_photos(*self.photos)
        places = self._inside() if self.inside else self._outside()
        places = places[self.surface.clearance(places) > _TOO_NEAR][:_PLACES]
        seen, around = self.surface.seen_from(places)
        if self.inside:
            places, seen = places[around >= _ENCLOSED], seen[around >= _ENCLOSED]
        owner = torch.arange(len(places)).repeat_interleave(_TURNS[self.inside])
        eyes = places[owner]
        targets = self._ahead(eyes) if self.inside else self._at_content(seen[owner])
        viewmats = look_at(eyes, targets, self.box.up)
        return viewmats, owner, self._shown(viewmats, seen[:, :_COMPARED][owner])

    def _like_photos(self, places: Tensor, shares: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`_candidates`, about where photos were taken: ``places`` (P, 3) by their ``shares`` (P,). What the
        SH of a point, if there are any, do not say to have been shown from there counts for little."""
        drawn = torch.multinomial(shares.float(), 2 * _PLACES, replacement=True, generator=self.generator)
        places = places[drawn] + _PHOTOS_APART * torch.randn(len(drawn), 3, generator=self.generator).double()
        if self.inside:
            places = torch.cat([places, self._inside()[: 2 * _PLACES]])
        places = places[self.surface.clearance(places) > _PHOTO_TOO_NEAR]
        points, sh = self.surface.points[:_COMPARED], self.surface.sh[:_COMPARED]
        seen = self.surface.seen_from(places)[0][:, :_COMPARED]
        told = torch.full((len(places), _COMPARED), float(TELLING))
        if bool(sh.any()):
            for row, place in zip(told, places, strict=True):
                row.copy_(explained(points - place, sh))
        best = ((seen * told).sum(1) / seen.sum(1).clamp_min(1)).topk(min(2 * _PLACES, len(places))).indices
        places, seen, told = places[best], seen[best], told[best]
        owner = torch.arange(len(places)).repeat_interleave(_TURNS[True])
        worth = seen * self.surface.shown[:_COMPARED] * told / TELLING
        near = 1 / (1 + torch.cdist(places.float(), points.float()).square())
        weights = (worth * near + 1e-12)[owner]
        at = torch.multinomial(weights, 1, generator=self.generator)[:, 0] if len(owner) else owner
        viewmats = look_at(places[owner], points[at], self.box.up)
        shown = self._shown(viewmats, seen[owner])
        gains = shown * worth[owner]
        average = gains.sum(1) / shown.sum(1).clamp_min(1e-6)
        like_photos = average >= (_LIKE_PHOTOS * average.quantile(0.9) if len(owner) else 0.0)
        return viewmats[like_photos], owner[like_photos], gains[like_photos]

    def _inside(self) -> Tensor:
        places = self.box.places(4 * _PLACES, self.generator)
        heights = self.box.heights(places)
        return places[(heights > _HEIGHTS[0]) & (heights < _HEIGHTS[1])]

    def _outside(self) -> Tensor:
        turn, lift, far = torch.rand(3, 2 * _PLACES, generator=self.generator, dtype=torch.float64)
        low, high = (math.sin(math.radians(angle)) for angle in _ELEVATION)
        lift = low + (high - low) * lift
        rays = (1 - lift.square()).sqrt()[:, None] * level_directions(self.box.up, 2 * math.pi * turn) + lift[
            :, None
        ] * self.box.up
        places = rays * (_DISTANCE[0] + (_DISTANCE[1] - _DISTANCE[0]) * far)[:, None]
        return places[self.box.heights(places) > _ABOVE_GROUND]

    def _ahead(self, eyes: Tensor) -> Tensor:
        """What cameras at ``eyes`` (V, 3) in a room look at, turned evenly at each place."""
        turns = _TURNS[True]
        first = torch.rand(len(eyes) // turns, generator=self.generator, dtype=torch.float64)
        turn = 2 * math.pi * (first[:, None] + torch.arange(turns) / turns).reshape(-1)
        mean, deviation, low, high = _PITCH
        pitch = mean + deviation * torch.randn(len(eyes), generator=self.generator, dtype=torch.float64)
        pitch = torch.deg2rad(pitch.clamp(low, high))
        return eyes + pitch.cos()[:, None] * level_directions(self.box.up, turn) + pitch.sin()[:, None] * self.box.up

    def _at_content(self, seen: Tensor) -> Tensor:
        """Targets (V, 3) between the middle of an object and a visible point of it."""
        near = self.surface.points.norm(dim=1) < 0.6 * UNITS
        weights = (seen & near).float() + 1e-9
        drawn = torch.multinomial(weights, 1, generator=self.generator)[:, 0] if len(seen) else seen.new_zeros(0).long()
        share = torch.rand(len(seen), 1, generator=self.generator, dtype=torch.float64)
        return 0.7 * share * self.surface.points[drawn]

    def _shown(self, viewmats: Tensor, seen: Tensor) -> Tensor:
        """How well views (V, 4, 4) show points, of which ``seen`` (V, P) are visible, (V, P) float32."""
        points = self.surface.points[:_COMPARED].float()
        x, y, z = (viewmats[:, :3, :3].float() @ points.T + viewmats[:, :3, 3:].float()).unbind(1)
        edge = math.tan(math.radians(FIELD_OF_VIEW) / 2) * torch.tensor([self.width, self.height])
        edge = edge / max(self.width, self.height)
        aside = torch.maximum(x.abs() / edge[0], y.abs() / edge[1]) / z.clamp_min(1e-6)
        inside = seen & (z > 0) & (aside < 1)
        return inside * (1 - 0.5 * aside.square().clamp_max(1)) / (1 + (z / _FAR).square())

    def _is_free(self, viewmat: Tensor) -> bool:
        """Whether a view shows enough, and hardly any surface that is very near."""
        close = _TOO_NEAR if self.photos is None else _PHOTO_TOO_NEAR
        view = _views(viewmat[None], self.width, self.height, NEAR_PLANE * UNITS).resized(_PROBE_SIDE)[0]
        depth, alpha = render_depth(self.small, view)
        too_near = (alpha > 0.5) & (depth < close)
        if float(alpha.mean()) < _COVERED[self.inside] or float(too_near.float().mean()) >= _NEAR_PIXELS:
            return False
        return self._blur(viewmat) <= self.most_blur

    def _blur(self, viewmat: Tensor) -> float:
        """Median of what Gaussians subtend in a view, radians, by their shares of the picture; 0 of an empty one."""
        view = _views(viewmat[None], self.width, self.height, NEAR_PLANE * UNITS).resized(_BLUR_SIDE)[0]
        shares = pixels_of(self.fine, view).double()
        away = (self.fine.means.double() @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=1)
        subtended, order = (self.sizes.double() / away.clamp_min(NEAR_PLANE)).sort()
        below = shares[order].cumsum(0)
        if not float(below[-1]) > 0:
            return 0.0
        return float(subtended[torch.searchsorted(below, 0.5 * below[-1])])
