"""The rasterizer as one would explain it: for each pixel, front to back. Slow; for tests.

Uses the textbook formulas (covariance matrices, conics, no tiles, no packing), so that a mistake in
the fast path is not shared. The output is differentiable by autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.geometry.transforms import SHORTEST
from pointsplat_ns.rendering.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    COMPENSATION_MIN,
    FRUSTUM_MARGIN,
    TRANSMITTANCE_MIN,
)
from pointsplat_ns.rendering.spherical_harmonics import sh_basis
from pointsplat_ns.scene.views import EPS2D
from pointsplat_ns.system.tensors import FLAGS, FLOATS


def _rotation(quat: Tensor) -> Tensor:
    if quat.abs().max() < SHORTEST:
        return torch.eye(3, dtype=quat.dtype, device="cpu")
    w, x, y, z = (quat.double() / quat.double().norm()).to(quat.dtype)
    q = torch.stack([x, y, z])
    zero = torch.zeros_like(w)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    return (
        (w * w - q @ q) * torch.eye(3, dtype=quat.dtype, device="cpu")
        + 2 * torch.outer(q, q)
        + 2 * w * cross
    )


def _det(m: Tensor) -> Tensor:
    return m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0]


def rasterize_reference(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3] standard deviations
    opacities: Tensor,  # [N]
    colors: Tensor,  # [N, D] or [N, K, 3]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    sh_degree: int | None = None,
    antialiased: bool = False,
    eps2d: float = EPS2D,
) -> tuple[Tensor, Tensor, Tensor]:
    """One camera's image over black (H, W, D), alphas (H, W, 1) and summed depths (H, W, 1)."""
    W = viewmat[:3, :3]
    t = viewmat[:3, 3]
    fx = K[0, 0]
    fy = K[1, 1]
    cx = K[0, 2]
    cy = K[1, 2]
    points = means @ W.T + t
    ys, xs = torch.meshgrid(
        torch.arange(height, **FLOATS) + 0.5, torch.arange(width, **FLOATS) + 0.5, indexing="ij"
    )
    pixels = torch.stack([xs, ys], -1).to(means.dtype)
    through = torch.ones(height, width, dtype=means.dtype, device="cpu")
    alive = torch.ones(height, width, **FLAGS)
    depth = torch.zeros_like(through)
    image = None

    for i in torch.argsort(points[:, 2].detach(), stable=True).tolist():
        x, y, z = points[i]
        parameters = torch.cat([points[i], quats[i], scales[i], opacities[i, None]])
        if (
            not parameters.isfinite().all()
            or (scales[i] < 0).any()
            or not near_plane < z < far_plane
        ):
            continue
        # Jacobian of the projection, evaluated inside the enlarged field of view
        half_x = 0.5 * width / fx
        half_y = 0.5 * height / fy
        tx = z * torch.clamp(
            x / z, -cx / fx - FRUSTUM_MARGIN * half_x, (width - cx) / fx + FRUSTUM_MARGIN * half_x
        )
        ty = z * torch.clamp(
            y / z, -cy / fy - FRUSTUM_MARGIN * half_y, (height - cy) / fy + FRUSTUM_MARGIN * half_y
        )
        zero = torch.zeros_like(z)
        J = torch.stack([fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2]).view(2, 3)
        R = _rotation(quats[i])
        covariance = R @ torch.diag(scales[i] ** 2) @ R.T
        cov2d = J @ W @ covariance @ W.T @ J.T
        blurred = cov2d + eps2d * torch.eye(2, dtype=means.dtype, device="cpu")
        opacity = opacities[i]
        if antialiased:
            ratio = _det(cov2d) / _det(blurred)
            opacity = opacity * ratio.clamp_min(COMPENSATION_MIN**2).sqrt()
        offset = pixels - torch.stack([fx * x / z + cx, fy * y / z + cy])
        sigma = 0.5 * torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(blurred), offset)
        alpha = torch.clamp(opacity * torch.exp(-sigma), max=ALPHA_MAX)
        if sh_degree is None:
            color = colors[i]
        else:
            centre = -torch.linalg.inv(W) @ t
            direction = (means[i] - centre) / (means[i] - centre).norm()
            basis = sh_basis(direction[None], sh_degree)[0]
            color = (basis @ colors[i, : basis.shape[0]] + 0.5).clamp_min(0)
        drawn = alive & (alpha >= ALPHA_MIN)
        after = through * (1 - alpha)
        alive = alive & ~(drawn & (after <= TRANSMITTANCE_MIN))
        drawn = drawn & alive
        weight = torch.where(drawn, alpha * through, torch.zeros_like(alpha))
        image = weight[..., None] * color if image is None else image + weight[..., None] * color
        depth = depth + weight * z
        through = torch.where(drawn, after, through)

    if image is None:
        image = means.new_zeros(height, width, 3 if sh_degree is not None else colors.shape[-1])
    return image, 1 - through[..., None], depth[..., None]
