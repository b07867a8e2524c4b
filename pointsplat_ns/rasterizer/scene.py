"""Pictures and depth images of a whole scene."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.rendering import rasterization
from pointsplat_ns.system.thread_choice import ThreadChoice
from pointsplat_ns.system.threads import one_thread
from pointsplat_ns.views import View, Views

_RENDERS = ThreadChoice()


def render(scene: Gaussians, views: View | Views) -> Tensor:
    """What a scene looks like from one view or several, over the views' background. Differentiable in the scene.

    Args:
        scene: N Gaussians, on any device; the picture is rendered there.
        views: a :class:`~pointsplat_ns.View`, or :class:`~pointsplat_ns.Views`, whose pictures are then drawn one after
            the other.

    Returns:
        Colours in [0, 1]: (H, W, 3) for a view, (C, H, W, 3) for C views.

    Raises:
        ValueError: if a camera is not finite or has no focal length.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 2, width=64, height=48)
        >>> tuple(ps.render(room, views[0]).shape), tuple(ps.render(room, views).shape)
        ((48, 64, 3), (2, 48, 64, 3))
    """
    if isinstance(views, Views):
        if len(views) == 0:
            return scene.means.new_zeros(0, views.height, views.width, 3)
        return torch.stack([render(scene, view) for view in views])
    with _RENDERS.step(_work(scene, views), scene.device):
        image, alpha, _ = rasterization(
            means=scene.means,
            quats=scene.quats,
            scales=scene.stds,
            opacities=_alphas(scene),
            colors=scene.sh,
            viewmats=views.viewmat[None].to(scene.device),  # float32 would move a camera that is far from the origin
            Ks=views.K[None].to(scene.means),
            width=views.width,
            height=views.height,
            sh_degree=scene.sh_degree,
            near_plane=views.near_plane,
            far_plane=math.inf,  # the unit of length may be small
            rasterize_mode=views.rasterize_mode,
        )
        return (image[0] + (1 - alpha[0]) * views.background.to(image)).clamp(0, 1)


def render_depth(scene: Gaussians, view: View) -> tuple[Tensor, Tensor]:
    """How far what a view shows is, and how much of it there is.

    Args:
        scene: N Gaussians, on any device; the images are rendered there.
        view: the camera.

    Returns:
        Expected depth (H, W) along the camera's z axis, scene units, and alpha (H, W) in [0, 1].
    """
    with _RENDERS.step(_work(scene, view), scene.device):
        depth, alpha, _ = rasterization(
            means=scene.means,
            quats=scene.quats,
            scales=scene.stds,
            opacities=_alphas(scene),
            colors=scene.means,  # any colours: only depths are rendered
            viewmats=view.viewmat[None].to(scene.device),
            Ks=view.K[None].to(scene.means),
            width=view.width,
            height=view.height,
            render_mode="ED",
            near_plane=view.near_plane,
            far_plane=math.inf,
            rasterize_mode=view.rasterize_mode,
        )
    return depth[0, ..., 0], alpha[0, ..., 0]


def _work(scene: Gaussians, view: View) -> int:
    """How much work an image is, roughly: Gaussians are projected, and pixels blended."""
    return len(scene) + view.width * view.height


def _alphas(scene: Gaussians) -> Tensor:
    """Opacities (N,). Where the shares of threads end, torch rounds a sigmoid in another way: so one computes all."""
    with one_thread():
        return scene.alphas
