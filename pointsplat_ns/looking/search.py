"""The search for views of a scene: places, directions, and which of them show most.

All is in units of the content (its diagonal is 10).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.poses import FIELD_OF_VIEW, NEAR_PLANE, look_at, views_of
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import TELLING, explained
from pointsplat_ns.looking.upright import UprightBox, level_directions
from pointsplat_ns.rasterizer import pixels_of, render_depth

_PROBE_SIDE = 32
"""Longer side, in pixels, of these images."""

TOO_NEAR = 0.5
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

_BLUR_SIDE = 64
"""Longer side of these pictures, pixels."""

_COVERED = {True: 0.7, False: 0.05}
"""Least mean alpha of the image. Inside it must show something nearly everywhere; an object may stand before
nothing."""

ENCLOSED = 0.6
"""Least share of all directions in which there is a surface, for a place inside a room."""

_HEIGHTS = (0.3, 0.75)
"""Where eyes are between the floor and the ceiling of a room."""

_PITCH = (-10.0, 8.0, -30.0, 10.0)
"""Mean, standard deviation and bounds of how far up a camera in a room looks, degrees."""

_ELEVATION = (-5.0, 60.0)
"""How far above an object's middle it is looked at from, degrees."""

_ABOVE_GROUND = 0.05
"""Least height of a camera outside, as a share of the content's."""

DISTANCE = (5.5, 9.5)
"""How far from an object's middle cameras are, units."""

PLACES = 48
"""Number of places, at most, whose views compete for being taken."""

_TURNS = {True: 8, False: 4}
"""Number of views at each place, inside and outside."""

_ROUND = 16
"""Number of views, at most, that are taken before other places are drawn."""

_COMPARED = 4096
"""Number of points that views compete for."""

_FAR = 4.0
"""Distance, units, from which on a surface counts less, as it is then small in the image."""

_SHARP = 0.015
"""Standard deviation, radians, that a Gaussian subtends in a view that shows it half as well as from afar: photos are
taken from where most is smaller. In compact scenes of seven captures and splats it gains 0.2 dB."""

_NOVEL = 0.1
"""Once a point has been shown this well (1 is in the middle of a picture and near), it counts half."""

_REFUSED = 32
"""A round ends after so many candidates in a row that something stands in front of; in trained scenes three were the
most."""

_FRUITLESS = 4
"""Rounds without any view after which the search ends."""

_SEARCHED = 2.0
"""A search ends with fewer views after so many times the rounds that it needs if nothing is refused, and two more."""


@dataclass
class Search:
    """A search for views, all of it in units of the content."""

    small: Gaussians
    fine: Gaussians | None
    """More of the scene's Gaussians; None if views may be blurred."""
    sizes: Tensor | None
    """Widths (n,) of these Gaussians as they are in the scene."""
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
        typical = 0.0 if self.sizes is None else float(self.sizes.median()) / (0.5 * UNITS)
        self.most_blur = max(_BLURRED, _COARSE * typical)

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
        within = self._views_from(self._inside(), True)
        if self.inside:
            return within
        # Parts of what is no room as a whole may be enclosed, such as the rooms of a flat without its walls.
        about = self._views_from(self._outside(), False)
        viewmats, owner, gains = (torch.cat(both) for both in zip(about, within, strict=True))
        owner[len(about[1]) :] += PLACES
        return viewmats, owner, gains

    def _views_from(self, places: Tensor, inside: bool) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`_candidates`, from the free ones of ``places`` (P, 3); if ``inside``, from the enclosed ones, all
        round, else towards the content."""
        places = places[self.surface.clearance(places) > TOO_NEAR][:PLACES]
        seen, around = self.surface.seen_from(places)
        if inside:
            places, seen = places[around >= ENCLOSED], seen[around >= ENCLOSED]
        owner = torch.arange(len(places)).repeat_interleave(_TURNS[inside])
        eyes = places[owner]
        targets = self._ahead(eyes) if inside else self._at_content(seen[owner])
        viewmats = look_at(eyes, targets, self.box.up)
        return viewmats, owner, self._shown(viewmats, seen[:, :_COMPARED][owner])

    def _like_photos(self, places: Tensor, shares: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """As :meth:`_candidates`, about where photos were taken: ``places`` (P, 3) by their ``shares`` (P,). What the
        SH of a point, if there are any, do not say to have been shown from there counts for little."""
        drawn = torch.multinomial(shares.float(), 2 * PLACES, replacement=True, generator=self.generator)
        places = places[drawn] + _PHOTOS_APART * torch.randn(len(drawn), 3, generator=self.generator).double()
        if self.inside:
            places = torch.cat([places, self._inside()[: 2 * PLACES]])
        places = places[self.surface.clearance(places) > _PHOTO_TOO_NEAR]
        points, sh = self.surface.points[:_COMPARED], self.surface.sh[:_COMPARED]
        seen = self.surface.seen_from(places)[0][:, :_COMPARED]
        told = torch.full((len(places), _COMPARED), float(TELLING))
        if bool(sh.any()):
            for row, place in zip(told, places, strict=True):
                row.copy_(explained(points - place, sh))
        best = ((seen * told).sum(1) / seen.sum(1).clamp_min(1)).topk(min(2 * PLACES, len(places))).indices
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
        places = self.box.places(4 * PLACES, self.generator)
        heights = self.box.heights(places)
        return places[(heights > _HEIGHTS[0]) & (heights < _HEIGHTS[1])]

    def _outside(self) -> Tensor:
        turn, lift, far = torch.rand(3, 2 * PLACES, generator=self.generator, dtype=torch.float64)
        low, high = (math.sin(math.radians(angle)) for angle in _ELEVATION)
        lift = low + (high - low) * lift
        rays = (1 - lift.square()).sqrt()[:, None] * level_directions(self.box.up, 2 * math.pi * turn) + lift[
            :, None
        ] * self.box.up
        places = rays * (DISTANCE[0] + (DISTANCE[1] - DISTANCE[0]) * far)[:, None]
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
        subtended = self.surface.widths[:_COMPARED] / z.clamp_min(1e-6)
        sharp = 1 / (1 + (subtended / _SHARP).square())
        return inside * sharp * (1 - 0.5 * aside.square().clamp_max(1)) / (1 + (z / _FAR).square())

    def _is_free(self, viewmat: Tensor) -> bool:
        """Whether a view shows enough, and hardly any surface that is very near."""
        close = TOO_NEAR if self.photos is None else _PHOTO_TOO_NEAR
        view = views_of(viewmat[None], self.width, self.height, NEAR_PLANE * UNITS).resized(_PROBE_SIDE)[0]
        depth, alpha = render_depth(self.small, view)
        too_near = (alpha > 0.5) & (depth < close)
        if float(alpha.mean()) < _COVERED[self.inside] or float(too_near.float().mean()) >= _NEAR_PIXELS:
            return False
        return self._blur(viewmat) <= self.most_blur

    def _blur(self, viewmat: Tensor) -> float:
        """Median of what Gaussians subtend in a view, radians, by their shares of the picture; 0 of an empty one, and
        if views may be blurred."""
        if self.fine is None or self.sizes is None:
            return 0.0
        view = views_of(viewmat[None], self.width, self.height, NEAR_PLANE * UNITS).resized(_BLUR_SIDE)[0]
        shares = pixels_of(self.fine, view).double()
        away = (self.fine.means.double() @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=1)
        subtended, order = (self.sizes.double() / away.clamp_min(NEAR_PLANE)).sort()
        below = shares[order].cumsum(0)
        if not float(below[-1]) > 0:
            return 0.0
        return float(subtended[torch.searchsorted(below, 0.5 * below[-1])])
