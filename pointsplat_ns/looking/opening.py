"""The views in which people see a scene first: its subject whole and upright, or from where people stood.

A person who opens a scene wants one picture that shows what it is, and then others. An object is shown whole: people
are as likely to take a picture of all of it (:mod:`~pointsplat_ns.looking.candidates`) as others. In a room or
outdoors, where nobody stands outside of everything, they are not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.content import UNITS, in_scene_units, views_in_units
from pointsplat_ns.looking.poses import views_of
from pointsplat_ns.looking.sampling import Sampler
from pointsplat_ns.looking.upright import Up
from pointsplat_ns.looking.whole import around, whole_views
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
) -> Opening:
    """The views in which to show a scene first.

    If a view from around the scene, which shows all of it, is at least as likely as half of the known views, or of
    sampled ones, it comes first, and others of its kind or known ones follow. Else known or sampled views come, the
    likeliest first. Views complete each other.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1; fewer are returned where there are no more.
        width: of the pictures, pixels, if the views are not known ones.
        height: of the pictures, pixels.
        up: which way is up; by default what the scene declares, or estimated.
        known: views that people took or chose. Their size, background and rasterize mode apply to all views.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    sampler = Sampler(scene, (width, height), up)
    content, candidates = sampler.content, sampler.candidates
    if known is None:
        generator = torch.Generator().manual_seed(0)
        others = views_of(candidates.views(24, generator), width, height, UNITS)
    else:
        others, width, height = views_in_units(known, *content), known.width, known.height

    def outside(turns: Tensor) -> Views:
        return whole_views(sampler.surface, sampler.up.direction, turns, 20.0, width, height)

    turns = around(12)
    whole_likelihoods, whole_shown = candidates.judged(outside(turns))
    likelihoods, shown = candidates.judged(others)
    best = int(whole_likelihoods.argmax())
    if float(whole_likelihoods[best]) < float(likelihoods.median()):
        taken = candidates.completing(likelihoods, shown, count)
        views = in_scene_units(others, *content)[taken] if known is None else known[taken]
        return Opening(views, sampler.up, False)
    if known is None:
        return Opening(in_scene_units(outside(turns[best] + around(count)), *content), sampler.up, True)
    taken = candidates.completing(likelihoods, shown & ~whole_shown[best], count - 1)
    first = in_scene_units(outside(turns[best : best + 1]), *content)
    viewmats = torch.cat([first.viewmats, known.viewmats[taken].to(first.viewmats)])
    Ks = torch.cat([first.Ks, known.Ks[taken].to(first.Ks)])
    return Opening(replace(known, viewmats=viewmats, Ks=Ks), sampler.up, True)
