"""The first views that a viewer shows: the whole subject, upright, or places where people stood.

A viewer opens with one image that shows the whole subject, followed by others. An object is shown
whole: photos of all of it are as likely as others (:mod:`~pointsplat_ns.view_sampling.sampler`). In
a room or outdoors, where no camera stands outside of everything, they are not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import ImageSize, Views
from pointsplat_ns.view_sampling.content import in_scene_units, views_in_units
from pointsplat_ns.view_sampling.poses import around, whole_views
from pointsplat_ns.view_sampling.sampler import Sampler
from pointsplat_ns.view_sampling.upright import Up


@dataclass(frozen=True, eq=False)
class Opening:
    """The first views that a viewer shows."""

    views: Views
    """The first is the opening view."""
    up: Up
    whole: bool
    """Whether the opening view shows the whole scene from outside: an object, not a room."""


@torch.no_grad()
def opening_views(
    scene: Gaussians,
    count: int = 1,
    width: int = 960,
    height: int = 600,
    up: Up | None = None,
    known: Views | None = None,
) -> Opening:
    """The first views of a scene to show.

    If a view from outside, which shows all of the scene, is at least as likely as half of the known
    or sampled views, it comes first, followed by others of its kind or known ones. Otherwise known
    or sampled views follow, likeliest first. Views complement each other.

    Args:
        scene: N Gaussians.
        count: number of views, at least 1; fewer are returned if there are no more.
        width: of the images, pixels, unless the views are known ones.
        height: of the images, pixels.
        up: up direction; by default declared by the scene, or estimated.
        known: views chosen by people. Their most common size, background and rasterize mode apply
            to a view from outside.

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
    first = outside[best : best + 1]
    others = known[taken]
    viewmats = torch.cat([first.viewmats, others.viewmats.to(outside.viewmats)])
    Ks = torch.cat([first.Ks, others.Ks.to(outside.Ks)])
    common = ImageSize(known.width, known.height, known.eps2d)
    images = [common, *others.size_of_each()]
    return Opening(replace(known, viewmats=viewmats, Ks=Ks, images=images), sampler.up, True)
