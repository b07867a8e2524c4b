"""The content of a scene: its centre and size, conversion to its units, and thinning."""

from __future__ import annotations

import dataclasses
import math

import torch
from torch import Tensor

from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.tensors import DOUBLES

UNITS = 10.0
"""Diagonal of the content after :func:`in_units`. Absolute sizes of rendering, such as the near
plane, are small compared to it."""


def content_box(scene: Gaussians) -> tuple[Tensor, Tensor] | None:
    """Corners (3,), (3,) of the box with 90 % of the scene's opacity along each axis, scene units,
    float64; None if nothing of the scene is visible."""
    means = scene.means.double()
    alphas = scene.alphas.double()
    visible = scene.usable() & (alphas > 0)
    if not bool(visible.any()):
        return None
    means = means[visible]
    alphas = alphas[visible]
    corners = []
    for axis in means.unbind(1):
        ranked, order = axis.sort()
        below = alphas[order].cumsum(0)
        ends = torch.searchsorted(below, below[-1] * below.new_tensor([0.05, 0.95]))
        corners.append(ranked[ends.clamp_max(len(ranked) - 1)])
    low, high = torch.stack(corners, dim=1)
    return low, high


def content_size(scene: Gaussians) -> tuple[Tensor, float]:
    """Centre (3,), float64, on the CPU, and diagonal of the content of a scene, scene units.

    If the content is a point (one Gaussian, or all at one position), the diagonal is four times the
    largest standard deviation, or 1 if that is 0 or not finite. A scene without visible content has
    its centre at 0 and a diagonal of 1.
    """
    box = content_box(scene)
    if box is None:
        return torch.zeros(3, **DOUBLES), 1.0
    low, high = box
    size = float((high - low).norm()) or 4 * float(scene.stds[scene.usable()].double().amax())
    return 0.5 * (low + high).cpu(), size if 0 < size < math.inf else 1.0


def in_units(scene: Gaussians, centre: Tensor, size: float) -> Gaussians:
    """A scene moved and scaled so that the content is centred at 0 with a diagonal of
    :data:`UNITS`; positions are computed in float64."""
    means = (scene.means.double() - centre.to(scene.device)) * (UNITS / size)
    return scene.replace(means=means.to(scene.dtype), scales=scene.scales + math.log(UNITS / size))


def views_in_units(views: Views, centre: Tensor, size: float) -> Views:
    """Convert views of a scene to views of the scene :func:`in_units`; float64, on the CPU."""
    viewmats = views.viewmats.double().cpu().clone()
    viewmats[:, :3, 3] += viewmats[:, :3, :3] @ centre
    viewmats[:, :3, 3] *= UNITS / size
    near_plane = views.near_plane * UNITS / size
    Ks = views.Ks.double().cpu()
    background = views.background.cpu()
    return dataclasses.replace(
        views, viewmats=viewmats, Ks=Ks, background=background, near_plane=near_plane
    )


def in_scene_units(views: Views, centre: Tensor, size: float) -> Views:
    """Convert views in units of the content to views of the scene, the inverse of
    :func:`views_in_units`."""
    viewmats = views.viewmats.clone()
    viewmats[:, :3, 3] *= size / UNITS
    viewmats[:, :3, 3] -= viewmats[:, :3, :3] @ centre
    return dataclasses.replace(views, viewmats=viewmats, near_plane=views.near_plane * size / UNITS)


def thinning(count: int, max_count: int) -> int:
    """Step n such that :func:`thinned` selects every n-th of ``count`` Gaussians."""
    return max(1, count // max_count)


def thinned(scene: Gaussians, max_count: int) -> Gaussians:
    """Every n-th Gaussian, at most about ``max_count``, enlarged to cover as much as all."""
    step = thinning(len(scene), max_count)
    return enlarged(scene[::step], step)


def every_nth(scene: Gaussians, members: Tensor, step: int) -> Gaussians:
    """Every ``step``-th of the Gaussians with indices ``members`` (n,), without SH, enlarged to
    cover as much as all members."""
    return enlarged(scene.replace(features_rest=scene.features_rest[:, :0])[members[::step]], step)


def enlarged(scene: Gaussians, times: float) -> Gaussians:
    """Gaussians with ``times`` the area."""
    return scene.replace(scales=scene.scales + 0.5 * math.log(times))
