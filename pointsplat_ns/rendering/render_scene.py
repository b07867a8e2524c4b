"""Renders images and depth maps of a whole scene."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.rendering import whole_pictures as pictures
from pointsplat_ns.rendering.constants import ALPHA_MIN, QUALITIES
from pointsplat_ns.rendering.projection import camera_to, drawn_antialiased
from pointsplat_ns.rendering.rasterize import Colors, QualityName, rasterization
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View, Views, sizes_text
from pointsplat_ns.system.threads import one_thread_each


def render(
    scene: Gaussians,
    views: View | Views,
    quality: QualityName = "exact",
    backend: Literal["torch", "gsplat", "auto"] = "torch",
) -> Tensor:
    """Render a scene from one or several views, over the views' background. Differentiable in the
    scene. The image is antialiased if the scene or the view is.

    Args:
        scene: N Gaussians, on any device, which renders the image.
        views: a :class:`~pointsplat_ns.View`, or :class:`~pointsplat_ns.Views` of one image size,
            which are rendered one after the other.
        quality: "exact", or faster and less accurate, "balanced" or "fast", as for
            :func:`pointsplat_ns.rasterization`.
        backend: "torch", or gsplat if it can be used ("auto"), as for
            :func:`pointsplat_ns.rasterization`. gsplat does not check its input.

    Returns:
        Colours in [0, 1]: (H, W, 3) for a view, (C, H, W, 3) for C views.

    Raises:
        TypeError: if ``views`` has another type.
        ValueError: if a camera is not finite or has no focal length, the quality is unknown, or the
            views have several image sizes.

    Warns:
        UserWarning: if some Gaussians are not :meth:`~pointsplat_ns.Gaussians.usable`; their
        gradients are 0.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 2, width=64, height=48)
        >>> tuple(ps.render(room, views[0]).shape), tuple(ps.render(room, views).shape)
        ((48, 64, 3), (2, 48, 64, 3))
    """
    if isinstance(views, Views):
        if views.images is not None:
            raise ValueError(
                f"views have images of {sizes_text(views.image_sizes())} pixels; expected one "
                "size, or one view at a time: [render(scene, view) for view in views]"
            )
        if len(views) == 0:
            return scene.means.new_zeros(0, views.height, views.width, 3)
        return torch.stack([render(scene, view, quality, backend) for view in views])
    if not isinstance(views, View):
        raise TypeError(
            f"views is {views!r}; expected a View or Views, such as sample_views(scene, 3)"
        )
    return render_with_alpha(scene, views, quality, backend)[0]


def render_with_alpha(
    scene: Gaussians,
    view: View,
    quality: QualityName = "exact",
    backend: Literal["torch", "gsplat", "auto"] = "torch",
) -> tuple[Tensor, Tensor]:
    """Image (H, W, 3) and alpha (H, W, 1) of one view, both in [0, 1]. Arguments and errors are
    those of :func:`render`."""
    with one_thread_each():
        fixed = not (
            torch.is_grad_enabled()
            and (view.viewmat.requires_grad or view.background.requires_grad)
        )
        if fixed and backend == "torch" and quality in QUALITIES and pictures.can_draw(scene, None):
            drawn = pictures.picture(
                scene, camera_to(scene, view), view.background, QUALITIES[quality]
            )
            if drawn is not None:
                image, alpha, skipped = drawn
                _warn_of(skipped, scene)
                return image, alpha
        colors = scene.features_dc, scene.features_rest
        options = {"sh_degree": scene.sh_degree, "quality": quality, "backend": backend}
        image, alpha = _rasterized(scene, view, colors, **options)
        return (image + (1 - alpha) * view.background.to(image)).clamp(0, 1), alpha


def _rasterized(scene: Gaussians, view: View, colors: Colors, **options) -> tuple[Tensor, Tensor]:
    """Image (H, W, channels) and alphas (H, W, 1) of a scene with given colours; ``options`` are
    those of :func:`~pointsplat_ns.rasterization`."""
    image, alpha, meta = rasterization(
        means=scene.means,
        quats=scene.quats,
        scales=scene.stds,
        opacities=scene.alphas,
        colors=colors,
        viewmats=view.viewmat[None],
        Ks=view.K[None],
        width=view.width,
        height=view.height,
        near_plane=view.near_plane,
        far_plane=math.inf,  # scene units may be large, so depths may be small or large
        rasterize_mode="antialiased" if drawn_antialiased(scene, view) else "classic",
        eps2d=view.eps2d,
        **options,
    )
    _warn_of(meta.get("skipped", 0), scene)  # gsplat does not count
    return image[0], alpha[0]


def _warn_of(skipped: int, scene: Gaussians) -> None:
    """Warn about Gaussians with invalid values, which are not drawn; once for each number."""
    if skipped:
        text = f"{skipped} of {len(scene)} Gaussians have NaN or infinite values and are not drawn"
        warnings.warn(text, stacklevel=1)  # from one line, so that Python shows each text once


def render_depth(scene: Gaussians, view: View) -> tuple[Tensor, Tensor]:
    """Expected depth (H, W) along the camera's z axis, scene units, and alpha (H, W) in [0, 1], for
    each pixel of a view. Rendered on the scene's device."""
    with one_thread_each():
        colors = scene.means  # unused: only depths are rendered
        depth, alpha = _rasterized(scene, view, colors, render_mode="ED")
    return depth[..., 0], alpha[..., 0]


def pixels_of(scene: Gaussians, view: View, compiled: bool | None = None) -> Tensor:
    """Visible pixels of each Gaussian, (N,), at least float32: its blending weight, alpha times the
    transmittance in front of it, summed over the pixels of an image. Equals the gradient of the sum
    of the image by the colour; 0 if the Gaussian is not visible. ``compiled`` is that of
    :func:`pointsplat_ns.rasterization`."""
    with one_thread_each():
        if pictures.can_draw(single := _at_least_single(scene), compiled):
            weights = pictures.weights(single, camera_to(scene, view), ALPHA_MIN)
            if weights is not None:
                return weights
    return pixel_sums(scene, view, single.means.new_ones(view.height, view.width, 1), compiled)[
        :, 0
    ]


def pixels_of_each(scene: Gaussians, views: Views, compiled: bool | None = None) -> Tensor:
    """:func:`pixels_of` in each of V views, (V, N), faster for many small images: they share one
    call of the kernels, and each is drawn by one thread. Takes memory for one image per thread."""
    single = _at_least_single(scene)
    with one_thread_each():
        left: Sequence[int] = range(len(views))
        found = single.means.new_zeros(len(views), len(single))
        if len(views) and pictures.can_draw(single, compiled):
            cameras = [camera_to(scene, view) for view in views]
            found, left = pictures.weights_of_each(single, cameras, ALPHA_MIN)
        for index in left:
            found[index] = pixels_of(single, views[index], compiled)
    return found


def pixel_sums(scene: Gaussians, view: View, maps: Tensor, compiled: bool | None = None) -> Tensor:
    """Sums (N, D) over the pixels of a view of each Gaussian's blending weight times the values of
    D maps, (H, W, D); a map of ones gives :func:`pixels_of`."""
    scene = _at_least_single(scene)
    with one_thread_each(), torch.enable_grad():
        colors = torch.zeros(
            len(scene), maps.shape[-1], dtype=scene.dtype, device=scene.device
        ).requires_grad_()
        image, _ = _rasterized(scene, view, colors, compiled=compiled)
        (sums,) = torch.autograd.grad(image, colors, maps.to(image))
    return sums


def _at_least_single(scene: Gaussians) -> Gaussians:
    return scene.detach().to(torch.promote_types(scene.dtype, torch.float32))
