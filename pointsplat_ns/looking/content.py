"""Where the content of a scene is, and how large: what positions, distances and sizes are measured by."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.views import Views

UNITS = 10.0
"""Diagonal of the content after :func:`in_units`: all sizes that rendering knows, as that of its near plane, are small
against it."""


def content_box(scene: Gaussians) -> tuple[Tensor, Tensor]:
    """Corners (3,), (3,) of the box that holds 90 % of the scene's opacity along each axis, float64.

    Raises:
        DataError: if nothing of the scene is visible.
    """
    means, alphas = scene.means.double(), scene.alphas.double()
    seen = scene.usable() & (alphas > 0)
    if not bool(seen.any()):
        raise DataError("nothing of the scene can be seen, so there is no place to look from")
    means, alphas = means[seen], alphas[seen]
    corners = []
    for axis in means.unbind(1):
        ranked, order = axis.sort()
        below = alphas[order].cumsum(0)
        at = torch.searchsorted(below, below[-1] * below.new_tensor([0.05, 0.95])).clamp_max(len(ranked) - 1)
        corners.append(ranked[at])
    low, high = torch.stack(corners, dim=1)
    return low, high


def content_diagonal(scene: Gaussians, low: Tensor, high: Tensor) -> float:
    """Diagonal of the box with corners ``low`` (3,) and ``high`` (3,) that :func:`content_box` gives, scene units. If
    the box is a point (one Gaussian, or all at one position), four times the largest standard deviation; 1 if that is
    0."""
    return float((high - low).norm()) or 4 * float(scene.stds[scene.usable()].double().amax()) or 1.0


def content_size(scene: Gaussians) -> tuple[Tensor, float]:
    """Centre (3,) float64 and diagonal of the box that holds most of a scene's opacity; of the largest Gaussian if that
    box is a point; 1 if that is a point as well."""
    try:
        low, high = content_box(scene)
    except DataError:  # nothing can be seen
        return torch.zeros(3, dtype=torch.float64), 1.0
    size = float((high - low).norm())
    if size == 0:
        size = float(scene.stds[scene.usable()].double().amax())
    return 0.5 * (low + high).cpu(), size if 0 < size < math.inf else 1.0


def positions_in_units(positions: Tensor, centre: Tensor, size: float) -> Tensor:
    """Positions (..., 3) where the content has its centre at 0 and a diagonal of :data:`UNITS`, float64."""
    return (positions.double() - centre.to(positions.device)) * (UNITS / size)


def in_units(scene: Gaussians, centre: Tensor, size: float) -> Gaussians:
    """A scene moved and scaled as :func:`positions_in_units` moves and scales positions."""
    means = positions_in_units(scene.means, centre, size).to(scene.dtype)
    return scene.replace(means=means, scales=scene.scales + math.log(UNITS / size))


def views_in_units(views: Views, centre: Tensor, size: float) -> Views:
    """Views of a scene as views of it :func:`in_units`, float64, on the CPU."""
    viewmats = views.viewmats.double().cpu().clone()
    viewmats[:, :3, 3] += viewmats[:, :3, :3] @ centre
    viewmats[:, :3, 3] *= UNITS / size
    near_plane = views.near_plane * UNITS / size
    Ks, background = views.Ks.double().cpu(), views.background.cpu()
    return dataclasses.replace(views, viewmats=viewmats, Ks=Ks, background=background, near_plane=near_plane)


def thinned(scene: Gaussians, most: int) -> Gaussians:
    """At most about ``most`` Gaussians, evenly taken, grown so that they cover as much as all."""
    step = max(1, len(scene) // most)
    return _grown(Gaussians(*(value[::step] for value in scene.tensors())), step)


def some_of(scene: Gaussians, members: Tensor, step: int) -> Gaussians:
    """Every so many-th of the members (n,), without SH, grown so that they cover as much as all."""
    return _grown(scene.replace(features_rest=scene.features_rest[:, :0])[members[::step]], step)


def _grown(scene: Gaussians, step: int) -> Gaussians:
    """Gaussians that stand for so many each."""
    return scene.replace(scales=scene.scales + 0.5 * math.log(step))
