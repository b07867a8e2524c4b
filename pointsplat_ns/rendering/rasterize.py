"""The public rasterization function, with gsplat's signature, in plain torch."""

from __future__ import annotations

import functools
from dataclasses import fields, replace
from typing import Literal, cast

import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.rendering.arguments import check_options, check_tensors
from pointsplat_ns.rendering.blending import blend
from pointsplat_ns.rendering.constants import MEMORY_BUDGET, QUALITIES, TILE
from pointsplat_ns.rendering.projection import Projected, camera_of, count_meaningless, project
from pointsplat_ns.rendering.spherical_harmonics import sh_to_color
from pointsplat_ns.rendering.tiles import Footprints
from pointsplat_ns.scene.views import EPS2D
from pointsplat_ns.system.tensors import full_precision

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
QualityName = Literal["exact", "balanced", "fast"]
Colors = Tensor | tuple[Tensor, Tensor]
"""Channels or SH coefficients; or the first SH coefficient of each Gaussian, (N, 3), and the
others, (N, K - 1, 3)."""


@functools.cache
def gsplat_works() -> bool:
    """Whether gsplat's CUDA kernels are available. The first call may compile them, as Splatfacto's
    first step does."""
    if not torch.cuda.is_available():
        return False
    try:
        from gsplat.cuda._backend import _C
    except Exception:  # a failed compilation raises errors of many types
        return False
    return _C is not None


def use_gsplat(backend: str, device: torch.device) -> bool:
    """Whether ``backend`` ("gsplat" or "auto"; others raise ValueError) means gsplat for tensors on
    ``device``. Raises PointSplatError if gsplat is requested and cannot be used."""
    if backend not in ("gsplat", "auto"):
        raise ValueError(f"backend is {backend!r}; expected torch, gsplat or auto")
    usable = device.type == "cuda" and gsplat_works()
    if backend == "gsplat" and not usable:
        raise PointSplatError(
            f"backend gsplat: the Gaussians are on {device.type} and gsplat's CUDA kernels are "
            f"{'there' if gsplat_works() else 'not there'}; expected both on CUDA; use auto or "
            "torch"
        )
    return usable


def _cat(tensors: list[Tensor], dim: int = 0) -> Tensor:
    return tensors[0] if len(tensors) == 1 else torch.cat(tensors, dim)


def finite_colors(seen: Projected, *rest) -> tuple[Projected, Tensor, Tensor]:
    """Projected Gaussians and colours without those whose colour is NaN or too large, and the ids
    of the removed ones."""
    colors = _colors_of(seen, *rest)
    dropped = seen.ids[:0]
    # 6e30 in float32: gradients, sums over pixels of colours times slopes, stay finite
    limit = torch.finfo(colors.dtype).max ** 0.8
    # NaN makes both comparisons false
    if colors.numel() and not bool(torch.stack(colors.detach().aminmax()).abs().amax() < limit):
        usable = (colors.detach().abs() < limit).all(-1)
        dropped = seen.ids[~usable]
        # evaluated again instead of selected, so that the gradient never multiplies 0 by infinity
        seen = seen.select(usable.nonzero()[:, 0])
        colors = _colors_of(seen, *rest)
    return seen, colors, dropped


def _colors_of(
    seen: Projected, colors: Colors, sh_degree: int | None, compiled: bool | None
) -> Tensor:
    if sh_degree is None:
        return cast(Tensor, colors).index_select(0, seen.ids)
    first, rest = colors if isinstance(colors, tuple) else (colors[:, 0], colors[:, 1:])
    return sh_to_color(seen.directions, first, rest, sh_degree, seen.ids, compiled)


@full_precision
def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N] or [N, 1]
    colors: Colors,  # [N, D] or [N, K, 3], or [N, 3] and [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4], on any device
    Ks: Tensor,  # [C, 3, 3], on any device
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = EPS2D,
    sh_degree: int | None = None,
    packed: bool = True,
    tile_size: int = TILE,
    backgrounds: Tensor | None = None,
    render_mode: RenderMode = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    *,
    backend: Literal["torch", "gsplat", "auto"] = "torch",
    quality: QualityName = "exact",
    compiled: bool | None = None,
    memory_budget: int = MEMORY_BUDGET,
) -> tuple[Tensor, Tensor, dict]:
    """Render 3D Gaussians from C pinhole cameras, on any torch device.

    Called as ``gsplat.rasterization`` (1.4.0); docs/rasterizer.md lists the differences.
    Differentiable in means, quats, scales, opacities, colors, backgrounds and viewmats. float32 and
    float64 are computed in their own precision, lower precisions in float32, also under autocast.
    float64 viewmats with float32 Gaussians place the camera exactly, however far from the origin.
    Cameras should be on the CPU: from a GPU they are copied, which waits for all its pending work.

    Degenerate input is drawn: the zero quaternion is the identity, a scale of 0 a flat Gaussian.
    Gaussians with invalid values (NaN, infinities, a negative scale or opacity, a colour above
    6e30, whose gradients overflow float32) are not drawn, get a zero gradient and are counted in
    ``meta["skipped"]``.

    The same input gives the same bits, forward and backward, on the same machine and number of
    threads; with compiled kernels on any number. Otherwise images and gradients differ by 1e-6 of
    their size.

    Args:
        means: centres, world space.
        quats: wxyz, any length; shorter than 1e-38 is the identity.
        scales: standard deviations (not logarithms), scene units.
        opacities: in [0, 1].
        colors: D channels, or SH coefficients if ``sh_degree`` is given: one tensor, or two with
            the first coefficient and the others.
        viewmats: world to camera, OpenCV axes (x right, y down, z forward), rigid.
        Ks: intrinsics in pixels; the centre of the first pixel is at (0.5, 0.5).
        near_plane, far_plane: depths drawn, scene units.
        radius_clip: Gaussians of a smaller radius (pixels) are not drawn.
        eps2d: added to the diagonal of the projected covariance, pixels^2.
        sh_degree: degree to evaluate, at most that of ``colors``.
        packed: as in gsplat, ``meta`` then lists the M visible (camera, Gaussian) pairs instead of
            (C, N) arrays.
        backgrounds: (C, D), one colour a camera; depth channels are not composited over it.
        render_mode: colours, depth ``D`` (sum of weight times depth), expected depth ``ED``
            (``D`` divided by accumulated alpha), or both.
        absgrad: the backward pass adds the sum over pixels of the absolute gradient (AbsGS, arXiv
            2404.10484) to ``meta["means2d"].absgrad``.
        rasterize_mode: ``antialiased`` scales opacities by the compensation of Mip-Splatting.
        backend: renderer. "gsplat" calls gsplat itself, which needs CUDA; "auto" does so if
            possible. The arguments below have no effect on gsplat.
        quality: lowest drawn alpha, which trades accuracy for speed; see ``QUALITIES``.
        compiled: project and blend with compiled kernels, several times as fast as torch (CPU,
            float32; blending at most four channels): None if they were built; True warns if they
            were not; False never.
        memory_budget: bytes of the lists of pairs, above which the image is drawn in several bands,
            one after the other; the image is the same up to rounding.
        tile_size, sparse_grad, channel_chunk: accepted for gsplat's sake, without effect.

    Returns:
        Renders (C, H, W, channels), alphas (C, H, W, 1), and ``meta`` with means2d, radii, depths,
        conics, opacities (all (C, N, ...), or (M, ...) if packed), camera_ids and gaussian_ids
        (None unless packed), skipped (the number of Gaussians with invalid values; only colours of
        visible ones are checked), and sizes.

    Raises:
        ValueError: if a shape or option is invalid, or a camera has skew or is not a rigid motion;
            the message names the argument.
        PointSplatError: if gsplat is requested and cannot be used.

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()
        >>> views = ps.sample_views(room, 2, width=64, height=48)
        >>> renders, alphas, meta = ps.rasterization(
        ...     room.means, room.quats, room.stds, room.alphas, room.sh,
        ...     views.viewmats.float(), views.Ks.float(), width=64, height=48,
        ...     sh_degree=room.sh_degree,
        ... )
        >>> tuple(renders.shape), tuple(alphas.shape)
        ((2, 48, 64, 3), (2, 48, 64, 1))
    """
    if backend != "torch" and use_gsplat(backend, means.device):
        from gsplat.rendering import rasterization as gsplat_rasterization

        if isinstance(colors, tuple):
            colors = torch.cat([colors[0][:, None], colors[1]], dim=1)
        return gsplat_rasterization(
            means,
            quats,
            scales,
            opacities,
            colors,
            viewmats.to(means),
            Ks.to(means),
            width,
            height,
            near_plane,
            far_plane,
            radius_clip,
            eps2d,
            sh_degree,
            packed,
            16,
            backgrounds,
            render_mode,
            sparse_grad,
            absgrad,
            rasterize_mode,
            channel_chunk,
        )
    opacities = opacities[:, 0] if opacities.dim() == 2 and opacities.shape[1] == 1 else opacities
    check_tensors(
        colors,
        sh_degree,
        backgrounds,
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        viewmats=viewmats,
        Ks=Ks,
    )
    check_options(
        width,
        height,
        near_plane,
        far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        render_mode=render_mode,
        rasterize_mode=rasterize_mode,
        quality=quality,
        memory_budget=memory_budget,
    )
    dtype = means.dtype if means.dtype in (torch.float32, torch.float64) else torch.float32
    means, quats, scales, opacities = (
        tensor.to(dtype) for tensor in (means, quats, scales, opacities)
    )
    colors = (
        colors.to(dtype)
        if isinstance(colors, Tensor)
        else (colors[0].to(dtype), colors[1].to(dtype))
    )
    n = means.shape[0]
    cameras = viewmats.shape[0]
    limits = near_plane, far_plane, radius_clip, eps2d, rasterize_mode == "antialiased"
    seen = [
        project(
            means, quats, scales, opacities, camera_of(viewmat, K, width, height, *limits), compiled
        )
        for viewmat, K in zip(viewmats, Ks, strict=True)
    ]
    skipped = count_meaningless(means, quats, scales, opacities)
    colored: list[Tensor] = []  # of each camera
    if render_mode.startswith("RGB"):
        finite = [finite_colors(s, colors, sh_degree, compiled) for s in seen]
        seen = [projected for projected, _, _ in finite]
        colored = [values for _, values, _ in finite]
        skipped += torch.cat([bad for _, _, bad in finite]).unique().numel()
    camera_ids = _cat([torch.full_like(s.ids, c) for c, s in enumerate(seen)])
    drawn = Projected(
        **{f.name: _cat([getattr(s, f.name) for s in seen]) for f in fields(Projected)}
    )
    dense_ids = camera_ids * n + drawn.ids

    def dense(values: Tensor) -> Tensor:
        empty = values.new_zeros(cameras * n, *values.shape[1:])
        return empty.index_copy(0, dense_ids, values).view(cameras, n, *values.shape[1:])

    if packed:
        means2d = meta_means2d = drawn.means2d.view_as(drawn.means2d)
    else:
        meta_means2d = dense(drawn.means2d)
        means2d = meta_means2d.view(-1, 2).index_select(0, dense_ids)

    images = []
    throughs = []
    counts = [len(s.ids) for s in seen]
    if absgrad:
        absolute = torch.zeros_like(meta_means2d.detach())
        setattr(meta_means2d, "absgrad", absolute)  # noqa: B010 - as in gsplat
        rows = (torch.cumsum(torch.ones_like(dense_ids), 0) - 1 if packed else dense_ids).split(
            counts
        )
    for c, own in enumerate(means2d.split(counts)):
        channels = [colored[c]] if colored else []
        if render_mode != "RGB":
            channels.append(seen[c].depths[:, None])
        one = replace(seen[c], means2d=own)
        absolute_of = (absolute.view(-1, 2), rows[c]) if absgrad else None
        values = _cat(channels, dim=-1)
        kernels = compiled if values.shape[1] <= 4 else False  # limited to colours and depth
        footprints = Footprints(one, width, height, QUALITIES[quality], kernels)
        image, through = blend(one, values, footprints, memory_budget, absolute_of)
        images.append(image)
        throughs.append(through)
    image = torch.stack(images)
    through = torch.stack(throughs)
    accumulated = 1.0 - through

    if backgrounds is not None and colored:
        shades = colored[0].shape[-1]
        over = image[..., :shades] + through * backgrounds.to(dtype)[:, None, None, :]
        image = torch.cat([over, image[..., shades:]], dim=-1)
    if render_mode.endswith("ED"):
        expected = image[..., -1:] / accumulated.clamp_min(1e-10)
        image = torch.cat([image[..., :-1], expected], dim=-1)

    with torch.no_grad():
        arrays = {
            "radii": drawn.radii,
            "depths": drawn.depths.detach(),
            "conics": drawn.conics,
            "opacities": drawn.opacities.detach(),
        }
        if not packed:
            arrays = {name: dense(values) for name, values in arrays.items()}
    meta = {
        **arrays,
        "means2d": meta_means2d,
        "camera_ids": camera_ids if packed else None,
        "gaussian_ids": drawn.ids if packed else None,
        "skipped": skipped,
        "width": width,
        "height": height,
        "n_cameras": cameras,
        "tile_size": TILE,
        "tile_width": footprints.grid.columns,
        "tile_height": footprints.grid.rows,
    }
    return image, accumulated, meta
