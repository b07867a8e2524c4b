"""Scores from views of a scene: the image-driven baselines of the paper's Table 1.

Both need poses but no photos. They are exact sums over all pixels of all views.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.pruning.paper import log_volume
from pointsplat_ns.rendering.pixel_walk import PixelBlock, sum_over_pixels
from pointsplat_ns.rendering.projection import Projected, project_scene
from pointsplat_ns.rendering.spherical_harmonics import sh_to_color
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View, Views
from pointsplat_ns.system.tensors import FLOATS


def lightgaussian_score(
    scene: Gaussians, views: Views, progress: Callable[[float], None] | None = None
) -> Tensor:
    """LightGaussian's global significance (arXiv 2311.17245, eq. 3 and 4).

    ``sum over all pixels of 1(hit) * opacity * T``, times ``min(V / V_90, 1) ** 0.1``: T is the
    transmittance in front of the Gaussian at that pixel, V its volume, and V_90 the volume at 90 %
    of all volumes in descending order. The authors' released code omits T and the clamp at 1.

    Args:
        scene: N Gaussians.
        views: at least one view.
        progress: called with the share done, in [0, 1].

    Returns:
        Scores (N,), float64; zero for invisible Gaussians, NaN for those that cannot be drawn.

    Raises:
        DataError: if there is no view.
    """
    usable = scene.usable()
    scene = scene.to(torch.promote_types(scene.dtype, torch.float32))  # as in the rasterizer
    total = torch.zeros(len(scene), dtype=torch.float64, device=scene.device)

    def passed(block: PixelBlock) -> Tensor:
        return torch.where(block.alpha > 0, block.before, 0.0).sum(-1, keepdim=True)

    with torch.no_grad():
        for view in _each(views, progress):
            projected = project_scene(scene, view)
            through = sum_over_pixels(projected, view.width, view.height, 1, passed)[:, 0]
            total.index_add_(0, projected.ids, (projected.opacities * through).double())
        if bool(usable.any()):
            logs = log_volume(scene)
            ranked = logs[usable].sort(descending=True).values
            relative = logs - ranked[min(int(0.9 * len(ranked)), len(ranked) - 1)]
            # -Inf - -Inf is NaN: a flat Gaussian among flat ones has a relative volume of 1
            total *= torch.exp(0.1 * relative.nan_to_num(nan=0.0, posinf=0.0).clamp_max(0.0))
    return torch.where(usable, total, math.nan)


def pup_score(
    scene: Gaussians, views: Views, progress: Callable[[float], None] | None = None
) -> Tensor:
    """PUP-3DGS's spatial sensitivity (arXiv 2406.10219, section 3.1).

    ``log det H`` with ``H = sum over views, pixels and channels of g g^T``, the Gauss-Newton
    Hessian of the image's squared error, where g is the gradient of a pixel's channel by the
    Gaussian's mean (3) and log-scales (3), as in the authors' released code. It is exact and
    includes the change of colour with the viewing direction; values clamped at black or at the
    maximum of alpha have no gradient. The authors render at a quarter of the image width; here the
    views' own size is used.

    Args:
        scene: N Gaussians.
        views: at least one view; the image size determines the resolution of the sensitivity.
        progress: called with the share done, in [0, 1].

    Returns:
        Scores (N,), float64: -Inf if the image does not depend on one of the six parameters (for
        example for invisible Gaussians), NaN for Gaussians that cannot be drawn. Parameter
        combinations that no view determines get a small eigenvalue, see :func:`log_determinant`.

    Raises:
        DataError: if there is no view.
    """
    return log_determinant(sensitivity(scene, views, progress)).where(scene.usable(), math.nan)


def sensitivity(
    scene: Gaussians, views: Views, progress: Callable[[float], None] | None = None
) -> Tensor:
    """The 6 x 6 Hessian blocks of :func:`pup_score`, (N, 6, 6) float64, over the mean (world, scene
    units) and the log-scales."""
    # In float32, small eigenvalues, and so the scores of Gaussians that cover few pixels, are
    # rounding errors. In a room a quarter of the better half differed from float64.
    scene = scene.to(torch.float64).detach()
    total = torch.zeros(len(scene), 6, 6, dtype=torch.float64, device=scene.device)
    for view in _each(views, progress):
        means, scales = (value.detach().requires_grad_() for value in (scene.means, scene.scales))
        with torch.enable_grad():
            projected = project_scene(scene.replace(means=means, scales=scales), view)
            sh = scene.features_dc, scene.features_rest
            colors = sh_to_color(projected.directions, *sh, scene.sh_degree, projected.ids)
            in_plane = torch.cat(
                [projected.opacities.log()[:, None], projected.means2d, projected.cov2d], dim=1
            )
            shape = _jacobian(in_plane, means, scales, projected.ids)  # (M, 6, 6)
            color = _jacobian(colors, means, scales, projected.ids)  # (M, 3, 6)
        with torch.no_grad():
            sums = _second_moments(projected, colors.detach(), view).double()
            squares = sums[:, :36].view(-1, 6, 6)
            cross = sums[:, 36:54].view(-1, 3, 6)
            weight = sums[:, 54]
            mixed = shape.mT @ cross.mT @ color
            block = (
                shape.mT @ squares @ shape
                + mixed
                + mixed.mT
                + weight[:, None, None] * (color.mT @ color)
            )
            total.index_add_(0, projected.ids, block)
    return total


def log_determinant(blocks: Tensor) -> Tensor:
    """Logarithm of the determinants of symmetric positive semi-definite blocks, (N, D, D) to (N,);
    -Inf if the diagonal has a zero.

    Each block is first scaled to a unit diagonal, so that neither 1e-30 nor 1e30 under- or
    overflows. Eigenvalues are clamped at 1e-9: parameters that no view determines have eigenvalues
    of 0, whose computed logarithms would be rounding errors. So the result depends on the other
    eigenvalues.
    """
    diagonal = blocks.diagonal(dim1=-2, dim2=-1)
    ok = (diagonal > 0).all(-1) & blocks.isfinite().all(-1).all(-1)
    root = torch.where(ok[:, None], diagonal, 1.0).sqrt()
    unit = torch.where(ok[:, None, None], blocks, torch.eye(blocks.shape[-1], **FLOATS).to(blocks))
    # on the CPU: torch's linear algebra libraries for GPUs differ between machines
    values = torch.linalg.eigvalsh((unit / root[:, :, None] / root[:, None, :]).cpu()).to(
        root.device
    )
    result = values.clamp_min(1e-9).log().sum(-1) + 2 * root.log().sum(-1)
    return torch.where(ok, result, -math.inf)


def _second_moments(projected: Projected, colors: Tensor, view: View) -> Tensor:
    """(M, 55): for the gradient ``r phi`` of a channel by (log opacity, mean x, y, covariance xx,
    xy, yy), with r its gradient by log alpha, and the colour's weight w: sums of r^2 phi phi^T, of
    r w phi (by channel), of w^2."""
    background = view.background.to(colors)

    def values(block: PixelBlock) -> Tensor:
        weight = block.alpha * block.before  # (B, L, 64)
        shade = colors[block.ids]  # (B, L, 3)
        x = block.gx
        y = block.gy
        # (B, L, 6, 64)
        phi = torch.stack([torch.ones_like(weight), x, y, 0.5 * x * x, x * y, 0.5 * y * y], dim=-2)
        steep = block.alpha / (1 - block.alpha)
        square = torch.zeros_like(weight)
        cross = []
        for channel in range(3):
            lit = weight * shade[..., channel, None]
            total = lit.sum(1, keepdim=True) + (block.final * background[channel])[:, None]
            behind = total - lit.cumsum(1)
            slope = (lit - steep * behind).masked_fill_(block.clamped, 0.0)
            square += slope * slope
            cross.append((phi @ (slope * weight)[..., None])[..., 0])
        squares = (phi * square[..., None, :]) @ phi.mT  # (B, L, 6, 6)
        return torch.cat(
            [squares.flatten(-2), *cross, (weight * weight).sum(-1, keepdim=True)], dim=-1
        )

    return sum_over_pixels(projected, view.width, view.height, 55, values)


def _jacobian(outputs: Tensor, means: Tensor, scales: Tensor, ids: Tensor) -> Tensor:
    """Derivatives of (M, F) by the means and log-scales of the same Gaussians, (M, F, 6)
    float64."""
    if not outputs.requires_grad:  # colours of SH degree 0 depend on neither
        return outputs.new_zeros(*outputs.shape, 6, dtype=torch.float64)
    rows = []
    for column in outputs.unbind(1):
        grads = torch.autograd.grad(
            column.sum(), (means, scales), retain_graph=True, materialize_grads=True
        )
        rows.append(torch.cat([grad[ids] for grad in grads], dim=1))
    return torch.stack(rows, dim=1).double()


def _each(views: Views, progress: Callable[[float], None] | None) -> Iterator[View]:
    """The views, at least one; calls ``progress`` after each with the share done."""
    if len(views) == 0:
        raise DataError("no view to score from; expected at least one pose")
    for done, view in enumerate(views, 1):
        yield view
        if progress is not None:
            progress(done / len(views))
