"""From 3D Gaussians to 2D Gaussians in the image of one pinhole camera (EWA splatting).

The projected covariance is ``P P^T + eps2d I`` with ``P = J W R S`` (2 x 3). Its determinant is
summed from squares, ``det = |p1 x p2|^2 + eps2d (|p1|^2 + |p2|^2) + eps2d^2``, so that a needle does
not lose it to cancellation as ``xx yy - xy^2`` does in float32.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import ALPHA_MIN, COMPENSATION_MIN, FRUSTUM_MARGIN
from pointsplat_ns.rasterizer.spherical_harmonics import safe_normalize


@dataclass
class Projected:
    """The M Gaussians that a camera sees, packed."""

    ids: Tensor  # [M] int64, rows of the input, ascending
    means2d: Tensor  # [M, 2] pixels; the centre of the first pixel is (0.5, 0.5)
    depths: Tensor  # [M] along the optical axis
    cov2d: Tensor  # [M, 3] xx, xy, yy in pixels^2, eps2d included
    det: Tensor  # [M] determinant of cov2d
    opacities: Tensor  # [M] in (0, 1], compensation included
    directions: Tensor  # [M, 3] from the camera centre, world space
    radii: Tensor  # [M] int32, pixels, 3 standard deviations of the longest axis

    @property
    def conics(self) -> Tensor:
        """Inverse covariances, (M, 3): xx, xy, yy."""
        xx, xy, yy = self.cov2d.unbind(-1)
        return torch.stack([yy, -xy, xx], dim=-1) / self.det[:, None]


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Rotation matrices of wxyz quaternions of any length; the zero quaternion is the identity.

    Args:
        quats: (..., 4)

    Returns:
        (..., 3, 3)
    """
    w, x, y, z = safe_normalize(quats).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def camera_centre(viewmat: Tensor) -> Tensor:
    """Position of the camera in the world, (3,), in float64: the solution of ``R c = -t``.

    Solved rather than ``-R^T t``: a rotation stored in float32 is orthogonal to 1e-7 only, which a
    translation of 1e6 turns into a tenth of a unit.
    """
    viewmat = viewmat.double()
    return torch.linalg.solve(viewmat[:3, :3], -viewmat[:3, 3])


def _candidates(camera_points, max_std, opacities, K, width, height, near, far) -> Tensor:
    """Rows that may touch the image, by a bound on their extent that needs no covariance."""
    x, y, z = camera_points
    fx, fy, cx, cy = K[0, 0].abs(), K[1, 1].abs(), K[0, 2], K[1, 2]
    seen = (z > near) & (z < far) & (opacities >= ALPHA_MIN)
    # |J| is bounded by f / z times the length of (1, 1, limit); sqrt(2 ln 255) < 3.33 deviations
    slope = 1.0 + (1 + FRUSTUM_MARGIN) * (width / fx + height / fy + (cx / fx).abs() + (cy / fy).abs())
    reach = 3.4 * (max_std * slope * torch.maximum(fx, fy) / z + 1.0)
    px, py = K[0, 0] * x / z + cx, K[1, 1] * y / z + cy
    seen &= (px > -reach) & (px < width + reach) & (py > -reach) & (py < height + reach)
    return seen.nonzero()[:, 0]


def project(
    means: Tensor,  # [N, 3] world
    quats: Tensor,  # [N, 4] wxyz, any length
    scales: Tensor,  # [N, 3] standard deviations
    opacities: Tensor,  # [N] in [0, 1]
    viewmat: Tensor,  # [4, 4] world to camera, OpenCV axes
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    antialiased: bool = False,
) -> Projected:
    """Project the Gaussians that one camera sees; the others are left out.

    Left out are Gaussians with a non-finite parameter, nearer than ``near_plane`` or farther than
    ``far_plane``, fainter than 1/255, or whose 1/255 ellipse misses every pixel centre.
    Differentiable in means, quats, scales, opacities and viewmat.
    """
    rotation = viewmat[:3, :3]
    # R (m - c) and not R m + t: far from the origin the first rounds alike for all Gaussians
    centre = camera_centre(viewmat).to(means.dtype)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]

    with torch.no_grad():
        x, y, z = ((means - centre) @ rotation.T).unbind(-1)
        finite = scales.isfinite().all(-1) & quats.isfinite().all(-1) & (scales >= 0).all(-1)
        max_std = torch.where(finite, scales.amax(-1), torch.full_like(z, torch.nan))
        ids = _candidates((x, y, z), max_std, opacities, K, width, height, near_plane, far_plane)

    def gather(tensor: Tensor) -> Tensor:
        return tensor.index_select(0, ids)

    directions = gather(means) - centre
    x, y, z = (directions @ rotation.T).unbind(-1)
    rz = 1.0 / z
    means2d = torch.stack([fx * x * rz + cx, fy * y * rz + cy], dim=-1)

    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    tx = torch.clamp(x * rz, min=-(cx / fx + margin_x), max=(width - cx) / fx + margin_x)
    ty = torch.clamp(y * rz, min=-(cy / fy + margin_y), max=(height - cy) / fy + margin_y)

    frame = quat_to_rotmat(gather(quats)) * gather(scales)[:, None, :]  # (M, 3, 3) = R S
    frame = torch.matmul(rotation, frame)  # W R S
    jx, jy = (fx * rz)[:, None], (fy * rz)[:, None]
    p1 = jx * (frame[:, 0] - tx[:, None] * frame[:, 2])  # (M, 3)
    p2 = jy * (frame[:, 1] - ty[:, None] * frame[:, 2])
    xx0, yy0, xy = (p1 * p1).sum(-1), (p2 * p2).sum(-1), (p1 * p2).sum(-1)
    a1, a2, a3 = p1.unbind(-1)
    b1, b2, b3 = p2.unbind(-1)
    det0 = (a2 * b3 - a3 * b2) ** 2 + (a3 * b1 - a1 * b3) ** 2 + (a1 * b2 - a2 * b1) ** 2
    xx, yy = xx0 + eps2d, yy0 + eps2d
    det = det0 + eps2d * (xx0 + yy0) + eps2d * eps2d

    alphas = gather(opacities)
    if antialiased:
        alphas = alphas * (det0 / det).clamp_min(COMPENSATION_MIN**2).sqrt()

    with torch.no_grad():
        mid = 0.5 * (xx + yy)
        radii = 3.0 * (mid + (0.25 * (xx - yy) ** 2 + xy * xy).sqrt()).sqrt()
        level = 2.0 * (alphas / ALPHA_MIN).log()  # squared Mahalanobis distance of the 1/255 ellipse
        half_x, half_y = (level * xx).clamp_min(0).sqrt(), (level * yy).clamp_min(0).sqrt()
        mx, my = means2d.unbind(-1)
        keep = (level > 0) & det.isfinite() & (det > 0) & means2d.isfinite().all(-1) & (radii > radius_clip)
        keep &= (mx + half_x >= 0.5) & (mx - half_x <= width - 0.5)
        keep &= (my + half_y >= 0.5) & (my - half_y <= height - 0.5)
        kept = keep.nonzero()[:, 0]

    return Projected(
        ids=ids[kept],
        means2d=means2d.index_select(0, kept),
        depths=z.index_select(0, kept),
        cov2d=torch.stack([xx, xy, yy], dim=-1).index_select(0, kept),
        det=det.index_select(0, kept),
        opacities=alphas.index_select(0, kept),
        directions=directions.index_select(0, kept),
        radii=radii[kept].ceil().clamp_max(2**30).to(torch.int32),
    )
