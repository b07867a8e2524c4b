"""The formulas of EWA splatting as gsplat publishes them, in plain torch: what rounding costs when they are used as
they stand.

Written from the mathematical supplement of gsplat (arXiv 2312.02121) and its documentation: covariances R S S^T R^T as
matrices, cameras as ``R m + t``, the conic as the inverse of a 2 x 2 matrix by its determinant ``xx yy - xy^2``, a
low-pass filter of 0.3 pixels^2, and opacities multiplied by sqrt(det / det with the filter) if antialiased. Gradients
are autograd's. There are no tiles: every Gaussian is evaluated on every pixel, and not cut at 3 sigma, since that is
another definition of the picture and no rounding.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN, FRUSTUM_MARGIN, TRANSMITTANCE_MIN
from pointsplat_ns.rasterizer.spherical_harmonics import sh_basis
from pointsplat_ns.views import EPS2D


def rotations(quats: Tensor) -> Tensor:
    """Rotation matrices (N, 3, 3) of quaternions (N, 4), normalised by their length."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).view(-1, 3, 3)


def determinant(m: Tensor) -> Tensor:
    """Of symmetric matrices (N, 2, 2), (N,)."""
    return m[:, 0, 0] * m[:, 1, 1] - m[:, 0, 1] * m[:, 0, 1]


def draw(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    sh: Tensor,  # [N, 16, 3]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    near: float,
    antialiased: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    """One camera's image over black (H, W, 3), alphas (H, W, 1) and summed depths (H, W, 1), in the dtype of its
    input."""
    W, t = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    points = means @ W.T + t
    seen = points[:, 2].detach() > near
    order = points[seen, 2].detach().argsort(stable=True)

    def take(values: Tensor) -> Tensor:
        return values[seen][order]

    points, means, quats, scales, opacities, sh = map(take, (points, means, quats, scales, opacities, sh))
    x, y, z = points.unbind(-1)
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    tx = z * torch.clamp(x / z, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = z * torch.clamp(y / z, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * tx / z**2, zero, fy / z, -fy * ty / z**2], -1).view(-1, 2, 3)
    M = rotations(quats) * scales[:, None]
    cov = W @ (M @ M.mT) @ W.T
    cov2d = J @ cov @ J.mT
    blurred = cov2d + EPS2D * torch.eye(2).to(cov2d)
    det = determinant(blurred)
    if antialiased:
        opacities = opacities * (determinant(cov2d) / det).clamp_min(0.0).sqrt()
    conic_xx, conic_xy, conic_yy = blurred[:, 1, 1] / det, -blurred[:, 0, 1] / det, blurred[:, 0, 0] / det
    mean_x, mean_y = fx * x / z + cx, fy * y / z + cy

    rows, columns = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    dx = columns.flatten().to(means) + 0.5 - mean_x[:, None]
    dy = rows.flatten().to(means) + 0.5 - mean_y[:, None]
    sigma = 0.5 * (conic_xx[:, None] * dx * dx + conic_yy[:, None] * dy * dy) + conic_xy[:, None] * dx * dy
    alpha = (opacities[:, None] * torch.exp(-sigma)).clamp_max(ALPHA_MAX)
    used = (sigma >= 0) & (alpha >= ALPHA_MIN) & (det > 0)[:, None]  # NaN is not
    alpha = torch.where(used, alpha, 0.0)
    after = (1 - alpha).cumprod(0)
    before = torch.cat([torch.ones_like(after[:1]), after[:-1]])
    drawn = after.detach() > TRANSMITTANCE_MIN
    weight = torch.where(drawn, alpha * before, 0.0)

    directions = means - (-W.T @ t)
    basis = sh_basis(directions / directions.norm(dim=-1, keepdim=True), 3)
    colors = ((basis[:, None] @ sh)[:, 0] + 0.5).clamp_min(0)
    image, depth = weight.T @ colors, weight.T @ z
    return tuple(values.view(height, width, -1) for values in (image, weight.sum(0), depth))
