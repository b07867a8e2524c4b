"""The views in which people see a scene first: its subject whole and upright, or from where people
stood.

A person who opens a scene wants one picture that shows what it is, and then others. An object is
shown whole: people are as likely to take a picture of all of it
(:mod:`~pointsplat_ns.view_sampling.sampler`) as others. In a room or outdoors, where nobody stands
outside of everything, they are not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.content import in_scene_units, views_in_units
from pointsplat_ns.view_sampling.poses import around, whole_views
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.upright import Up


@dataclass(frozen=True, eq=False)
class Opening:
    """The views in which people see a scene first."""

    views: Views
    """The first is the one that a viewer opens with."""
    up: Up
    whole: bool
    """Whether the first view shows all of the scene from outside: an object to circle around, no
    room."""


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

    If a view from around the scene, which shows all of it, is at least as likely as half of the
    known views, or of sampled ones, it comes first, and others of its kind or known ones follow.
    Else known or sampled views come, the likeliest first. Views complete each other.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1; fewer are returned where there are no more.
        width: of the pictures, pixels, if the views are not known ones.
        height: of the pictures, pixels.
        up: which way is up; by default what the scene declares, or estimated.
        known: views that people took or chose. Their size, background and rasterize mode apply to
            all views.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    sampler = Sampler(scene, (width, height), up)
    others = sampler.views(24) if known is None else known
    likelihoods, shown = sampler.judged(views_in_units(others, *sampler.content))
    size = others.width, others.height
    outside = whole_views(sampler.surface.points, sampler.up.direction, around(12), 20.0, *size)
    whole_likelihoods, whole_shown = sampler.judged(outside)
    best = int(whole_likelihoods.argmax())
    if float(whole_likelihoods[best]) < float(likelihoods.median()):
        return Opening(others[sampler.completing(likelihoods, shown, count)], sampler.up, False)
    outside = in_scene_units(outside, *sampler.content)
    if known is None:
        sides = len(outside)
        count = min(count, len(outside))
        return Opening(
            outside[[(best + sides * place // count) % sides for place in range(count)]],
            sampler.up,
            True,
        )
    taken = sampler.completing(likelihoods, shown & ~whole_shown[best], count - 1)
    viewmats = torch.cat(
        [outside.viewmats[best : best + 1], known.viewmats[taken].to(outside.viewmats)]
    )
    Ks = torch.cat([outside.Ks[best : best + 1], known.Ks[taken].to(outside.Ks)])
    return Opening(replace(known, viewmats=viewmats, Ks=Ks), sampler.up, True)
