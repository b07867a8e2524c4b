"""The search for views of a scene: candidate places and directions, and the views with the largest coverage gains.

All is in units of the content (its diagonal is 10).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.poses import look_at, views_of
from pointsplat_ns.looking.settings import LOOKING, LookingSettings
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import PhotoPlaces, explained_energy
from pointsplat_ns.looking.upright import UprightBox, level_directions
from pointsplat_ns.rasterizer import pixels_of
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES


@dataclass
class ViewSearch:
    """A search for views, all of it in units of the content."""

    fine: Gaussians | None
    """Some of the scene's Gaussians, for the pictures that measure blur; None if views may be blurred."""
    widths: Tensor | None
    """Widths (n,) of these Gaussians, not enlarged."""
    surface: Surface
    box: UprightBox
    inside: bool
    """Whether the scene is a room."""
    width: int
    height: int
    generator: torch.Generator
    photos: PhotoPlaces | None
    """Photo places that views stand near; None for views from anywhere."""
    settings: LookingSettings = LOOKING
    max_blur: float = field(init=False)
    """Largest blur of a view, radians. It grows after each round that finds too few views."""

    def __post_init__(self) -> None:
        typical = 0.0 if self.widths is None else float(self.widths.median()) / (0.5 * UNITS)
        self.max_blur = max(self.settings.max_blur, self.settings.coarse_blur * typical)
        self._points = self.surface[: self.settings.gain_points]

    def views(self, count: int) -> Tensor:
        """At most ``count`` world-to-camera matrices (n, 4, 4), float64."""
        settings, points = self.settings, self._points
        coverage = torch.zeros(len(points.points), **FLOATS)
        values = torch.ones(len(coverage), **FLOATS) if self.photos is None else points.trace_factors
        taken: list[Tensor] = []
        for _ in range(settings.round_factor * math.ceil(count / settings.round_views)):
            viewmats, owner, gains = self._candidates()
            wanted, refused = min(count, len(taken) + settings.round_views), 0
            while len(taken) < wanted and refused < settings.max_refused and bool((owner >= 0).any()):
                total_gains = gains @ (1 / (settings.half_gain_coverage + coverage))
                best = int(total_gains.masked_fill(owner < 0, -1.0).argmax())
                if self._blur(viewmats[best]) <= self.max_blur:
                    taken.append(viewmats[best])
                    coverage += gains[best] / values
                    owner[owner == owner[best].item()] = -1  # one view a place
                    refused = 0
                else:
                    owner[best] = -1
                    refused += 1
            if len(taken) == count:
                break
            if len(taken) < wanted:  # blurred views are better than few places
                self.max_blur *= settings.blur_growth
        return torch.stack(taken) if taken else torch.empty(0, 4, 4, **DOUBLES)

    def _candidates(self) -> tuple[Tensor, Tensor, Tensor]:
        """Candidate views (V, 4, 4), the index (V,) of the place of each, and its gain (V, P) at each point."""
        if self.photos is not None:
            return self._near_photos(self.photos)
        if self.inside:
            return self._views_from(self.box.places_at_eyes(self.generator, self.settings), True)
        around = self._views_from(self._outside(), False)
        within = self._views_from(self.box.places_at_eyes(self.generator, self.settings), True)
        viewmats, owner, gains = (torch.cat(both) for both in zip(around, within, strict=True))
        owner[len(around[1]) :] += self.settings.places
        return viewmats, owner, gains

    def _views_from(self, places: Tensor, inside: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Candidates from the free ones of ``places`` (P, 3): in all level directions from enclosed places if
        ``inside``, else towards the content."""
        settings = self.settings
        places = places[self.surface.clearance(places) > settings.min_clearance][: settings.places]
        visible, enclosure = self.surface.visible_from(places)
        if inside:
            enclosed = enclosure >= settings.min_enclosure
            places, visible = places[enclosed], visible[enclosed]
        turns = settings.turns_inside if inside else settings.turns_outside
        owner = torch.arange(len(places), **INDICES).repeat_interleave(turns)
        eyes = places[owner]
        targets = self._ahead(eyes) if inside else self._at_content(visible[owner])
        viewmats = look_at(eyes, targets, self.box.up)
        return viewmats, owner, self._gains(viewmats, visible[:, : settings.gain_points][owner])

    def _near_photos(self, photos: PhotoPlaces) -> tuple[Tensor, Tensor, Tensor]:
        """Candidates near photo places, which are drawn by their shares. A point has a value for each place: its trace
        factor times the evidence that photos showed it from there. The gain at a point is its coverage gain times its
        value."""
        settings, points = self.settings, self._points
        count = settings.draws * settings.places
        drawn = torch.multinomial(photos.shares.float(), count, replacement=True, generator=self.generator)
        offsets = torch.randn(len(drawn), 3, generator=self.generator, **FLOATS).double()
        places = photos.places[drawn] + settings.photo_place_deviation * offsets
        if self.inside:
            places = torch.cat([places, self.box.places_at_eyes(self.generator, self.settings)[:count]])
        places = places[self.surface.clearance(places) > settings.min_clearance_photos]
        visible = self.surface.visible_from(places)[0][:, : settings.gain_points]
        evidence = torch.ones(visible.shape, **FLOATS)  # relative to the smallest of a photo place
        if bool(points.sh.any()):
            for row, place in zip(evidence, places, strict=True):
                row.copy_(explained_energy(points.points - place, points.sh, settings) / settings.min_sh_evidence)
        means = (visible * evidence).sum(1) / visible.sum(1).clamp_min(1)
        best = means.topk(min(count, len(places))).indices
        places, visible, evidence = places[best], visible[best], evidence[best]
        owner = torch.arange(len(places), **INDICES).repeat_interleave(settings.turns_inside)
        values = visible * points.trace_factors * evidence
        chances = (values + 1e-12)[owner]
        target = torch.multinomial(chances, 1, generator=self.generator)[:, 0] if len(owner) else owner
        viewmats = look_at(places[owner], points.points[target], self.box.up)
        return viewmats, owner, self._gains(viewmats, visible[owner]) * values[owner]

    def _outside(self) -> Tensor:
        """Places (P, 3) around the content."""
        settings, up = self.settings, self.box.up
        turn, lift, far = torch.rand(3, settings.draws * settings.places, generator=self.generator, **DOUBLES)
        low, high = (math.sin(math.radians(angle)) for angle in settings.elevations)
        lift = low + (high - low) * lift
        level = (1 - lift.square()).sqrt()[:, None] * level_directions(up, 2 * math.pi * turn)
        near, farthest = settings.distances
        return (level + lift[:, None] * up) * (near + (farthest - near) * far)[:, None]

    def _ahead(self, eyes: Tensor) -> Tensor:
        """Targets (V, 3) of cameras at ``eyes`` (V, 3) in a room, turned evenly at each place."""
        settings, up = self.settings, self.box.up
        turns = settings.turns_inside
        first = torch.rand(len(eyes) // turns, generator=self.generator, **DOUBLES)
        turn = 2 * math.pi * (first[:, None] + torch.arange(turns, **FLOATS) / turns).reshape(-1)
        normal = torch.randn(len(eyes), generator=self.generator, **DOUBLES)
        pitch = torch.deg2rad(settings.pitch_mean + settings.pitch_deviation * normal)
        return eyes + pitch.cos()[:, None] * level_directions(up, turn) + pitch.sin()[:, None] * up

    def _at_content(self, visible: Tensor) -> Tensor:
        """Targets (V, 3), each between the centre of the content and a point of it that is ``visible`` (V, M)."""
        near = self.surface.points.norm(dim=1) < self.settings.content_radius
        chances = (visible & near).float() + 1e-9
        drawn = torch.empty(0, **INDICES)
        if len(visible):
            drawn = torch.multinomial(chances, 1, generator=self.generator)[:, 0]
        share = torch.rand(len(visible), 1, generator=self.generator, **DOUBLES)
        return self.settings.target_share * share * self.surface.points[drawn]

    def _gains(self, viewmats: Tensor, visible: Tensor) -> Tensor:
        """Coverage (V, P) that views (V, 4, 4) add at points, float32: 1 for a point nearby
        and of a small Gaussian, 0 outside of the picture and for points that are not ``visible`` (V, P)."""
        settings, points = self.settings, self._points
        x, y, z = (viewmats[:, :3, :3].float() @ points.points.float().T + viewmats[:, :3, 3:].float()).unbind(1)
        edge = math.tan(math.radians(settings.field_of_view) / 2) * torch.tensor([self.width, self.height], **FLOATS)
        edge = edge / max(self.width, self.height)
        aside = torch.maximum(x.abs() / edge[0], y.abs() / edge[1]) / z.clamp_min(1e-6)
        in_picture = visible & (z > 0) & (aside < 1)
        subtended = points.widths / z.clamp_min(1e-6)
        sharp = 1 / (1 + (subtended / settings.half_gain_angle).square())
        return in_picture * sharp / (1 + (z / settings.half_gain_distance).square())

    def _blur(self, viewmat: Tensor) -> float:
        """Blur of a view (4, 4): median over its pixels of the angle that Gaussians' standard deviations subtend,
        radians; 0 if it shows nothing or if views may be blurred."""
        if self.fine is None or self.widths is None:
            return 0.0
        settings = self.settings
        view = views_of(viewmat[None], self.width, self.height, UNITS, settings).resized(settings.blur_side)[0]
        pixels = pixels_of(self.fine, view).double()
        distances = (self.fine.means.double() @ viewmat[:3, :3].T + viewmat[:3, 3]).norm(dim=1)
        subtended, order = (self.widths.double() / distances.clamp_min(1e-3)).sort()
        below = pixels[order].cumsum(0)
        if not float(below[-1]) > 0:
            return 0.0
        return float(subtended[torch.searchsorted(below, 0.5 * below[-1])])
