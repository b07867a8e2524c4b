"""The views in which people see a scene first: its subject whole and upright, or most of a room.

Views that decide stand near the content and complete each other; each of them may cut off a head. A person who opens a
scene wants one picture that shows what it is, and then others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, views_in_units
from pointsplat_ns.looking.poses import in_pictures, look_at, views_of
from pointsplat_ns.looking.sampling import Sampler, views_in_scene_units
from pointsplat_ns.looking.settings import LOOKING, LookingSettings
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import PhotoPlaces
from pointsplat_ns.looking.upright import Up, UprightBox, level_directions
from pointsplat_ns.looking.whole import around, few_in_units, shown, whole_views
from pointsplat_ns.system.tensors import FLAGS, INDICES
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class Opening:
    """The views in which people see a scene first."""

    views: Views
    """The first is the one that a viewer opens with."""
    up: Up
    whole: bool
    """Whether the first view shows all of the scene from outside: an object to circle around, no room."""


@torch.no_grad()
def opening_views(
    scene: Gaussians,
    count: int = 1,
    width: int = 960,
    height: int = 600,
    up: Up | None = None,
    known: Views | None = None,
    settings: LookingSettings = LOOKING,
) -> Opening:
    """The views in which to show a scene first.

    Cameras around the scene, which show all of it, compete with known views, or with views from enclosed places in it.
    The best view shows the most Gaussians. Views from outside come first unless the scene is a room, or one of the
    others shows clearly more.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1; fewer are returned where there are no more.
        width: of the pictures, pixels, if the views are not known ones.
        height: of the pictures, pixels.
        up: which way is up; by default what the scene declares, or estimated.
        known: views that people took or chose. Their size, background and rasterize mode apply to all views.
        settings: tuned numbers.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    sampler = Sampler(scene, (width, height), up, settings)
    centre, diagonal = sampler.content
    surface, box = sampler.surface, sampler.box
    if known is not None:
        width, height = known.width, known.height
    few = few_in_units(scene, settings.pictured_count, centre, diagonal)
    turns = around(settings.opening_turns)
    outside = whole_views(surface, box.up, turns, settings.opening_elevation, width, height)
    of_outside = shown(few, outside, settings.pictured_side)
    if known is None:
        inside = _inside(surface, box, sampler.photos, width, height)
    else:
        inside = views_in_units(known, centre, diagonal)
    of_inside = shown(few, inside, settings.pictured_side)
    most_outside, most_inside = (int(rows.sum(1).max()) if len(rows) else 0 for rows in (of_outside, of_inside))
    ratio = most_inside / max(most_outside, 1)
    whole = most_inside == 0 or not (sampler.inside or ratio > settings.opening_inside)
    if not whole:
        taken = _completing(of_inside, count)
        if known is not None:
            return Opening(known[taken], sampler.up, False)
        chosen = inside[taken].viewmats
    elif known is not None or ratio > settings.opening_beside:
        first = int(of_outside.sum(1).argmax())
        others = _completing(of_inside & ~of_outside[first], count - 1)
        chosen = torch.cat([outside[[first]].viewmats, inside[others].viewmats])
    else:
        sides = turns[of_outside.sum(1).argmax()] + around(count)
        chosen = whole_views(surface, box.up, sides, settings.opening_elevation, width, height).viewmats
    views = views_in_scene_units(chosen, width, height, centre, diagonal, settings)
    if known is not None:
        Ks = torch.cat([views.Ks[:1], known.Ks[others].to(views.Ks)])
        viewmats = torch.cat([views.viewmats[:1], known.viewmats[others].to(views.viewmats)])
        views = replace(known, viewmats=viewmats, Ks=Ks)
    return Opening(views, sampler.up, whole)


def _inside(surface: Surface, box: UprightBox, photos: PhotoPlaces | None, width: int, height: int) -> Views:
    """Views from enclosed places and from photo places, of all those that show most of the surface."""
    settings, up = surface.settings, box.up
    generator = torch.Generator().manual_seed(0)
    places = box.places_at_eyes(generator, settings)
    if photos is not None:
        best = photos.shares.topk(min(settings.places // 3, len(photos.shares))).indices
        places = torch.cat([photos.places[best], places])
    places = places[surface.clearance(places) > settings.min_clearance][: settings.places]
    visible, enclosure = surface.visible_from(places)
    places, visible = places[enclosure >= settings.min_enclosure], visible[enclosure >= settings.min_enclosure]
    count = settings.opening_turns
    turn = around(count).repeat(len(places))
    pitch = math.radians(settings.pitch_mean)
    eyes = places.repeat_interleave(count, dim=0)
    targets = eyes + math.cos(pitch) * level_directions(up, turn.to(up)) + math.sin(pitch) * up
    views = views_of(look_at(eyes, targets, up), width, height, UNITS, settings)
    some = settings.gain_points
    pictured = in_pictures(views, surface.points[:some])
    counts = (pictured & visible[:, :some].repeat_interleave(count, dim=0)).sum(1).view(-1, count)
    best = counts.argmax(1) + count * torch.arange(len(counts), **INDICES)  # one view a place
    return views[best[counts.amax(1).topk(min(settings.opening_candidates, len(best))).indices]]


def _completing(inside: Tensor, count: int) -> list[int]:
    """Indices of views, at most ``count``: first the one that shows the most Gaussians (C, N), then always the one that
    shows most of those that the others do not show."""
    taken: list[int] = []
    missing = torch.ones(inside.shape[1], **FLAGS)
    while len(taken) < min(count, len(inside)):
        new = (inside & missing).sum(1)
        new[taken] = -1
        taken.append(int(new.argmax()))
        missing &= ~inside[taken[-1]]
    return taken
