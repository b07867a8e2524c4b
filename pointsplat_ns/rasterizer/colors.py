"""Colours of Gaussians from spherical harmonics: in torch (:mod:`~pointsplat_ns.rasterizer.spherical_harmonics`), or by
compiled kernels where there is a compiler (:mod:`~pointsplat_ns.rasterizer.compiled.colors`)."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.compiled.colors import CompiledColor, can_color
from pointsplat_ns.rasterizer.spherical_harmonics import C0, Color, check_degree, offset


def sh_to_color(
    directions: Tensor, coefficients: Tensor, degree: int, ids: Tensor | None = None, compiled: bool | None = None
) -> Tensor:
    """Colours seen along directions, as 3DGS defines them: ``max(SH + 1/2, 0)``.

    Args:
        directions: (M, 3) from the camera centre to the Gaussian, world space, any length; a zero direction sees
            the basis at zero.
        coefficients: (M, K, 3), or (N, K, 3) with ``ids``; K >= (degree + 1)^2, the rest is ignored.
        degree: 0 to 3.
        ids: (M,) int64, each at most once: the row of ``coefficients`` that each direction belongs to.
        compiled: as for :func:`~pointsplat_ns.rasterization`.

    Returns:
        (M, 3), not below 0; NaN where a coefficient is not finite.

    Raises:
        ValueError: if the degree is not 0 to 3, or there are too few coefficients.
    """
    check_degree(degree)
    used = (degree + 1) ** 2
    if coefficients.shape[-2] < used:
        raise ValueError(f"{coefficients.shape[-2]} SH coefficients given; degree {degree} needs {used}")
    if ids is None:
        ids = torch.arange(coefficients.shape[0], device=coefficients.device)
    if can_color(directions, coefficients, compiled):
        # a constant has no direction
        return CompiledColor.apply(directions if degree else directions.detach(), coefficients, ids, degree)
    if degree == 0:
        return offset(C0 * coefficients[..., 0, :].index_select(0, ids)).clamp_min(0.0)
    return Color.apply(directions, coefficients, ids, degree)
