"""Finds Gaussians that no picture needs, so that a budget is spent on the others.

Three rules remove a Gaussian. First: it cannot be drawn, because a value is NaN or infinite, or its
opacity is below the rasterizer's threshold. Second: no camera sees it. Cameras stand at the
likeliest places and look in all directions. A Gaussian is unseen if its blend weight (opacity at a
pixel times transmittance in front of it) is zero on every pixel of every image. A visible
background stays, and so does a lamp that hangs in the air.

Third: it floats. A floater stands far in front of the visible surfaces, and pictures hardly change
without it (:func:`floating_scores`). A strength of 0 turns this rule off. Haze goes; a cup in front
of a wall stays, because pictures need its colour.
"""

from __future__ import annotations

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import Enum

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.neighbours import nearest
from pointsplat_ns.geometry.transforms import camera_positions
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.rendering import pixel_sums, pixels_of, render, render_depth
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.each_view import each_view
from pointsplat_ns.rendering.constants import ALPHA_MIN
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES
from pointsplat_ns.view_sampling.content import content_size, in_units
from pointsplat_ns.view_sampling.sampler import Sampler

PLACES = 16
"""Number of camera positions. More positions remove fewer Gaussians and take longer."""

FLOATING = 0.25
"""Maximum colour difference (root of the sum of squares of red, green and blue) of a floater right
in front of the camera, at a strength of 1. At half the strength, held-out photos lose at most 0.05
dB on average (``python -m lab.judge.cleaning RUN``)."""


@dataclass(frozen=True, eq=False)
class Junk:
    """Gaussians that no picture needs."""

    undrawable: Tensor  # [A] int64, unusable Gaussians first, then by rising opacity
    unseen: Tensor  # [B] int64, by rising opacity
    floating: Tensor  # [C] int64, by rising floating score
    places: int
    """Number of camera positions; 0 if nothing is visible, in which case no Gaussian is unseen."""

    def first(self, count: int) -> Junk:
        """The first ``count``: undrawable Gaussians, then unseen ones, then floating ones."""
        undrawable = self.undrawable[:count]
        unseen = self.unseen[: count - len(undrawable)]
        return Junk(
            undrawable=undrawable,
            unseen=unseen,
            floating=self.floating[: count - len(undrawable) - len(unseen)],
            places=self.places,
        )

    @property
    def indices(self) -> Tensor:
        """Indices of all, undrawable Gaussians first."""
        return torch.cat([self.undrawable, self.unseen, self.floating])


class Rule(Enum):
    """Why a Gaussian is removed."""

    UNDRAWABLE = "undrawable"
    UNSEEN = "unseen"
    FLOATING = "floating"


@dataclass(frozen=True)
class RuleEffect:
    """What one rule removes, together with the rules before it."""

    rule: Rule
    removed: int
    """Number of Gaussians that this rule removes."""
    places: int = 0
    """Number of camera positions, for unseen Gaussians; 0 if there was none."""
    clusters: int = 0
    """Number of clusters of floating Gaussians."""
    seen_in: int = 0
    """Number of views that decide which Gaussians float."""
    psnr: float | None = None
    """PSNR of renders after this rule and those before it, dB; inf for equal renders, None if not
    compared."""
    worst: float | None = None
    """The same of the worst view, dB."""
    views: int = 0
    """Number of compared views."""


@dataclass(frozen=True, eq=False)
class Cleaning:
    """The junk of a scene, and how renders change without it."""

    junk: Junk
    count: int
    """Number of Gaussians in the scene as read."""
    effects: tuple[RuleEffect, ...]
    """What each rule removes; empty if nothing is removed."""

    def apply(self, scene: Gaussians, at_least: int) -> Gaussians:
        """Remove the junk from the scene as read, or from a copy with fewer SH bands. The most
        opaque junk stays where fewer than ``at_least`` Gaussians would remain."""
        return _without(scene, self.junk.first(self.count - at_least).indices)


@torch.no_grad()
def find_junk(
    scene: Gaussians,
    progress: Progress = silent,
    floating: Views | None = None,
    strength: float = 0,
) -> Junk:
    """Find undrawable, unseen and, with a strength, floating Gaussians.

    The result is deterministic and, up to rounding, independent of the unit of length. If no
    Gaussian can be drawn, all are junk.

    Args:
        scene: N Gaussians.
        progress: called with the name of the current task and the share done, in [0, 1].
        floating: views that decide which Gaussians float; a Gaussian visible in them is not unseen.
        strength: strength of the third rule, in [0, 1].

    Returns:
        Indices, on the CPU.
    """
    usable = scene.usable()
    drawable = usable & (scene.alphas >= ALPHA_MIN)
    order = torch.where(usable, scene.alphas, -1.0).sort(stable=True).indices
    undrawable = order[~drawable[order]]
    drawn = drawable.nonzero()[:, 0]
    visible = ~drawable  # an undrawable Gaussian does not count as unseen too
    places = 0
    if len(drawn):
        part = scene[drawn]
        part = in_units(part, *content_size(part))  # independent of the scene's unit of length
        try:
            views = _views_all_around(part)
        except DataError:
            return Junk(
                undrawable=undrawable.cpu(),
                unseen=drawn[:0].cpu(),
                floating=drawn[:0].cpu(),
                places=0,
            )
        has_pixels = torch.zeros_like(drawn, dtype=torch.bool)
        for done, pixels in enumerate(each_view(part, views, pixels_of)):
            has_pixels |= pixels > 0
            progress("looking for unseen Gaussians", (done + 1) / len(views))
        places = len(views) // 6
        visible[drawn] = has_pixels | ~has_pixels.any()  # empty images are no evidence
    floats = order[:0]
    if floating is not None:
        scores = torch.full_like(scene.alphas, math.inf, dtype=torch.float64)
        scores[drawn], shown = floating_scores(scene[drawn], floating, progress)
        visible[drawn] |= shown
        scores, floats = scores.sort(stable=True)
        floats = floats[scores < strength]
    return Junk(
        undrawable=undrawable.cpu(),
        unseen=order[~visible[order]].cpu(),
        floating=floats.cpu(),
        places=places,
    )


def floating_scores(
    scene: Gaussians, views: Views, progress: Progress = silent
) -> tuple[Tensor, Tensor]:
    """Floating score (N,) float64 of each Gaussian, and whether any view shows it, (N,) bool.

    A low score marks a floater. It is infinite where no view shows the Gaussian in front of
    something else.

    Let r be the mean of the Gaussian's depth divided by the picture's depth, and d the mean squared
    difference of its colour (without SH) from the picture's, summed over red, green and blue, and
    at least 0.01 squared. Means are over all pixels of all views, weighted by blend weights. The
    score is ``sqrt(d / (1 - r)) / FLOATING``.
    """
    totals = torch.zeros(len(scene), 3, **DOUBLES).to(scene.device)
    for done, sums in enumerate(each_view(scene, views, _seen_through)):
        totals += sums
        progress("looking for floaters", (done + 1) / len(views))
    pixels, near, difference = totals.unbind(1)
    free = (pixels - near) / pixels  # NaN where no view shows it
    scores = ((difference / pixels).clamp_min(0.01**2) / free).sqrt() / FLOATING
    return torch.where(free > 0, scores, math.inf), pixels > 0


def _seen_through(scene: Gaussians, view: View) -> Tensor:
    """Sums (N, 3) float64 over the pixels of a view: blend weights; blend weights times the ratio
    of the Gaussian's depth to the picture's; blend weights times the squared colour difference."""
    picture = render(scene, view)
    depth, _ = render_depth(scene, view)
    closeness = torch.where(depth > 0, 1 / depth, 0.0)
    ones_and_closeness = torch.stack([torch.ones_like(depth), closeness], -1)
    pixels, near = pixel_sums(scene, view, ones_and_closeness).double().unbind(1)
    colours_and_squares = torch.cat([picture, picture.square().sum(-1, keepdim=True)], -1)
    shown = pixel_sums(scene, view, colours_and_squares).double()
    toward = view.viewmat[2].to(scene.device, torch.float64)
    depths = scene.means.double() @ toward[:3] + toward[3]
    colors = (0.5 + SH_C0 * scene.features_dc.double()).clamp(0, 1)
    difference = colors.square().sum(1) * pixels - 2 * (colors * shown[:, :3]).sum(1) + shown[:, 3]
    return torch.stack([pixels, depths * near, difference], 1)


def clusters(scene: Gaussians) -> Tensor:
    """Cluster index (N,) int64 of each of N drawable Gaussians; cluster 0 is the largest. Gaussians
    whose spheres of two standard deviations touch share a cluster."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if len(scene) == 0:
        return torch.empty(0, **INDICES)
    distances, near = nearest(scene.means, 16)
    reach = 2 * scene.stds.amax(1).double().cpu()
    first, rank = (distances <= reach[:, None] + reach[near]).nonzero().unbind(1)
    links = coo_matrix(
        (torch.ones(len(first), **DOUBLES), (first, near[first, rank])), (len(scene), len(scene))
    )
    labels = torch.from_numpy(connected_components(links, directed=False)[1]).long()
    return labels.bincount().argsort(descending=True, stable=True).argsort()[labels]


def clean_scene(
    dense: Gaussians,
    at_least: int,
    views: ViewProvider,
    progress: Progress = silent,
    strength: float | None = None,
) -> Cleaning:
    """Find the junk of a scene, and measure the PSNR of renders without it.

    With a strength, views decide which Gaussians float. A Gaussian that known views show is not
    unseen; sampled views count only with a strength. At least ``at_least`` Gaussians, in 1..N,
    remain."""
    floating = None
    with suppress(DataError):  # no views
        if strength is not None or views.known(1) is not None:
            floating = views.scored(VIEW_COUNTS.scored)
    junk = find_junk(dense, progress, floating, strength or 0.0)
    dropped = junk.first(len(dense) - at_least)
    if len(dropped.indices) == 0:
        return Cleaning(junk, len(dense), ())
    progress("comparing renders without junk", 0.0)
    try:
        reference = DenseReference(dense, views.scored(4))
    except DataError:  # no views
        reference = None

    def compared(effect: RuleEffect, so_far: Tensor) -> RuleEffect:
        if reference is None or effect.removed == 0:
            return effect
        psnr, worst = reference.psnr(_without(dense, so_far))
        return replace(effect, psnr=psnr, worst=worst, views=len(reference.views))

    effects = []
    if len(dropped.undrawable):
        effect = RuleEffect(Rule.UNDRAWABLE, len(dropped.undrawable))
        effects.append(compared(effect, dropped.undrawable))
    effect = RuleEffect(Rule.UNSEEN, len(dropped.unseen), places=junk.places)
    effects.append(compared(effect, torch.cat([dropped.undrawable, dropped.unseen])))
    if floating is not None and strength is not None:
        labels = clusters(dense[dropped.floating.to(dense.device)])
        effect = RuleEffect(
            Rule.FLOATING,
            len(dropped.floating),
            clusters=len(labels.unique()),
            seen_in=len(floating),
        )
        effects.append(compared(effect, dropped.indices))
    return Cleaning(junk, len(dense), tuple(effects))


def _without(scene: Gaussians, indices: Tensor) -> Gaussians:
    """The scene without the Gaussians at the given indices; the others keep their order."""
    if len(indices) == 0:
        return scene
    remaining = torch.ones(len(scene), dtype=torch.bool, device=scene.device)
    remaining[indices.to(scene.device)] = False
    return scene[remaining]


def _views_all_around(scene: Gaussians) -> Views:
    """Views in six directions from each of the likeliest camera positions, (6 P). Raises DataError
    if nothing is visible."""
    # Without SH: positions must not depend on where photos were taken.
    without_sh = scene.replace(features_rest=scene.features_rest[:, :0])
    # Few of the likeliest views are behind walls. Views for comparisons use another seed.
    views = Sampler(without_sh).views(PLACES, seed=17, likeliest=True)
    places = camera_positions(views.viewmats)
    forward = torch.cat([torch.eye(3, **DOUBLES), -torch.eye(3, **DOUBLES)])
    right = forward.roll(1, dims=1)
    down = torch.linalg.cross(forward, right)
    rotations = torch.stack([right, down, forward], dim=1).to(places)  # OpenCV axes
    viewmats = torch.eye(4, **FLOATS).to(places).repeat(len(places), 6, 1, 1)
    viewmats[..., :3, :3] = rotations
    viewmats[..., :3, 3] = -torch.einsum("dij,pj->pdi", rotations, places)
    # The size hardly changes the time. A coarse image shows more small Gaussians, because none is
    # drawn thinner than a pixel.
    side = 32  # pixels
    half = side / 2  # focal length of a field of view of 90 degrees
    K = torch.tensor([[half, 0.0, half], [0.0, half, half], [0.0, 0.0, 1.0]], **FLOATS)
    viewmats = viewmats.flatten(0, 1)
    return Views(viewmats, K.repeat(len(viewmats), 1, 1), side, side, torch.zeros(3, **FLOATS))
