"""Colours of Gaussians from spherical harmonics: in torch (:mod:`~pointsplat_ns.rasterizer.spherical_harmonics`), or by
compiled kernels where they were built (:mod:`~pointsplat_ns.rasterizer.compiled.colors`)."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.rasterizer.compiled import colors as compiled_colors
from pointsplat_ns.rasterizer.spherical_harmonics import Color, check_degree, offset


def sh_to_color(
    directions: Tensor,
    coefficients: Tensor | tuple[Tensor, Tensor],
    degree: int,
    ids: Tensor | None = None,
    compiled: bool | None = None,
) -> Tensor:
    """Colours seen along directions, as 3DGS defines them: ``max(SH + 1/2, 0)``.

    Args:
        directions: (M, 3) from the camera centre to the Gaussian, world space, any length; a zero direction sees
            the basis at zero.
        coefficients: (M, K, 3), or (N, K, 3) with ``ids``; K >= (degree + 1)^2, the rest is ignored. Or the first of
            each and the others, (N, 3) and (N, K - 1, 3): the kernels then bring nothing together.
        degree: 0 to 3.
        ids: (M,) int64, each at most once: the row of ``coefficients`` that each direction belongs to.
        compiled: as for :func:`~pointsplat_ns.rasterization`.

    Returns:
        (M, 3), not below 0; NaN where a coefficient is not finite.

    Raises:
        ValueError: if the degree is not 0 to 3, or there are too few coefficients.
    """
    check_degree(degree)
    first, rest = coefficients if isinstance(coefficients, tuple) else (coefficients, None)
    used, stored = (degree + 1) ** 2, first.shape[-2] if rest is None else 1 + rest.shape[-2]
    if stored < used:
        raise ValueError(f"{stored} SH coefficients given; degree {degree} needs {used}")
    if ids is None:
        ids = torch.arange(first.shape[0], device=first.device, dtype=torch.int64)
    if compiled_colors.KERNELS.usable_for(compiled, directions, first, *([] if rest is None else [rest])):
        # a constant has no direction
        return compiled_colors.CompiledColor.apply(
            directions if degree else directions.detach(), first, rest, ids, degree
        )
    if degree == 0:
        return offset(SH_C0 * (first[..., 0, :] if rest is None else first).index_select(0, ids)).clamp_min(0.0)
    return Color.apply(directions, first if rest is None else torch.cat([first[:, None], rest], 1), ids, degree)
