"""EWA splatting with a hand-derived gradient: :func:`projection.project` in torch.

Tensors are stored by component, (components, M), so that operations run over contiguous memory.
With ``W`` the camera's rotation, ``R`` that of the Gaussian, ``S`` its scales and ``J`` the
Jacobian of the projection, the rows of ``J W`` are

    fx / z * a,  a = W[0] - tx W[2]        fy / z * b,  b = W[1] - ty W[2]

and ``P = J W R S`` (2 x 3) has the rows ``p1 = fx / z * (R^T a) * s`` and ``p2 = fy / z * (R^T b) *
s``. The covariance is ``P P^T + eps2d I``. Its determinant is a sum of squares,

    det = |p1 x p2|^2 + eps2d (|p1|^2 + |p2|^2) + eps2d^2

which for a needle avoids the cancellation of ``xx yy - xy^2`` in float32.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.geometry.transforms import rotation_components, unit_rows
from pointsplat_ns.rendering.constants import ALPHA_MIN, COMPENSATION_MIN, FRUSTUM_MARGIN
from pointsplat_ns.system.tensors import full_precision


class Lens(NamedTuple):
    """Intrinsics of a camera and drawing limits."""

    fx: float  # pixels
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    near: float  # depth, scene units
    far: float
    radius_clip: float  # pixels
    eps2d: float  # pixels^2
    antialiased: bool

    def clamps(self) -> list[tuple[float, float]]:
        """Bounds of x / z and y / z for the Jacobian, relative to the principal point (gsplat
        #305)."""
        bounds = []
        for side, focal, middle in (
            (self.width, self.fx, self.cx),
            (self.height, self.fy, self.cy),
        ):
            margin = FRUSTUM_MARGIN * 0.5 * side / focal
            ends = -(middle / focal + margin), (side - middle) / focal + margin
            bounds.append((min(ends), max(ends)))  # a negative focal length mirrors
        return bounds

    def steepness(self) -> float:
        """Bound of ``|J| z``, pixels: the focal length times the length of (1, 1, clamp)."""
        return max(abs(self.fx), abs(self.fy)) * (
            1.0 + sum(abs(bound) for ends in self.clamps() for bound in ends)
        )


def longest_axis(dtype: torch.dtype) -> float:
    """Largest standard deviation in the image, pixels, 1e9 in float32: beyond it the determinant
    would overflow, and Gaussians are flat over any image anyway."""
    return torch.finfo(dtype).max ** 0.25 / 4


def longest_reach(dtype: torch.dtype, lens: Lens) -> float:
    """Largest standard deviation divided by depth: longer axes are clamped to it, and have no
    gradient. In float32, this changes at most 1e-9 of an image."""
    return longest_axis(dtype) / lens.steepness()


def _rotation_backward(
    quats: Tensor, a: Tensor, grad_a: Tensor, b: Tensor, grad_b: Tensor
) -> Tensor:
    """Gradient (4, M) of the unit quaternion, for ``R`` with the gradient ``a grad_a^T + b
    grad_b^T``."""
    w, x, y, z = quats

    def entry(i: int, j: int) -> Tensor:
        return torch.addcmul(a[i] * grad_a[j], b[i], grad_b[j])

    g00 = entry(0, 0)
    g11 = entry(1, 1)
    g22 = entry(2, 2)
    g01 = entry(0, 1)
    g10 = entry(1, 0)
    g02 = entry(0, 2)
    g20 = entry(2, 0)
    g12 = entry(1, 2)
    g21 = entry(2, 1)
    curl_x = g21 - g12
    curl_y = g02 - g20
    curl_z = g10 - g01
    sum_xy = g01 + g10
    sum_xz = g02 + g20
    sum_yz = g12 + g21
    grad = [
        x * curl_x + y * curl_y + z * curl_z,
        w * curl_x + y * sum_xy + z * sum_xz - 2 * x * (g11 + g22),
        w * curl_y + x * sum_xy + z * sum_yz - 2 * y * (g00 + g22),
        w * curl_z + x * sum_xz + y * sum_yz - 2 * z * (g00 + g11),
    ]
    return 2 * torch.stack(grad)


def _cross(p: Tensor, q: Tensor) -> list[Tensor]:
    """Cross product of rows (3, M). Each component uses two columns of P, so a needle's is
    exact."""
    return [p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0]]


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Transposed matrices (3, 3, M) times vectors (3, M)."""
    out = matrix[0] * vector[0]
    return out.addcmul_(matrix[1], vector[1]).addcmul_(matrix[2], vector[2])


def _candidates(points: Tensor, scales: Tensor, opacities: Tensor, lens: Lens) -> Tensor:
    """Rows of Gaussians that may touch the image, by a bound of their extent without covariance."""
    x, y, z = points
    max_std = torch.maximum(torch.maximum(scales[:, 0], scales[:, 1]), scales[:, 2])  # NaN stays
    seen = (z > lens.near) & (z < lens.far) & (opacities >= ALPHA_MIN) & (max_std < torch.inf)
    # sqrt(2 ln 255) < 3.33 deviations
    rz = 1.0 / z
    reach = max_std.mul_(rz).mul_(3.4 * lens.steepness()).add_(3.4)
    px = x * rz * lens.fx + lens.cx
    py = y * rz * lens.fy + lens.cy
    seen &= (px > -reach) & (px < lens.width + reach) & (py > -reach) & (py < lens.height + reach)
    return seen.nonzero()[:, 0]


class _Shape(NamedTuple):
    """The projected covariance and its intermediate values, all (..., M)."""

    a: Tensor  # [3, M]
    b: Tensor  # [3, M]
    rotation: Tensor  # [3, 3, M] of the Gaussian
    turned_a: Tensor  # [3, M] R^T a
    turned_b: Tensor
    p1: Tensor  # [3, M] pixels
    p2: Tensor


def _shape(
    slopes: Tensor, rz: Tensor, quats: Tensor, scales: Tensor, view: Tensor, lens: Lens
) -> _Shape:
    """From x / z and y / z (2, M), 1 / z (M), unit quaternions (4, M) and scales (3, M)."""
    tx, ty = (slope.clamp(*ends) for slope, ends in zip(slopes, lens.clamps(), strict=True))
    a = torch.addcmul(view[0, :, None], tx, view[2, :, None], value=-1)
    b = torch.addcmul(view[1, :, None], ty, view[2, :, None], value=-1)
    rotation = rotation_components(quats)
    turned_a = _times(rotation, a)
    turned_b = _times(rotation, b)
    reach = scales * rz
    return _Shape(
        a, b, rotation, turned_a, turned_b, turned_a * reach * lens.fx, turned_b * reach * lens.fy
    )


class Project(torch.autograd.Function):
    """Project the Gaussians that one camera sees; see :func:`projection.project`. The camera's
    rotation and centre, and their gradients, are on the CPU in float64, whatever the device of the
    Gaussians."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, view, centre, lens: Lens):
        # the centre in two parts: at 1e6 from the origin, float32 alone would move the camera by
        # 0.03 units
        near_centre = centre.to(means.dtype)
        remainder = (centre - near_centre).to(means.dtype)
        offset = -(view.to(means.dtype) @ remainder)[:, None].to(means.device)
        wide, centre, near_centre = (
            values.to(means.device) for values in (view, centre, near_centre)
        )
        view = wide.to(means.dtype)
        points = torch.addmm(offset, view, (means - near_centre).T)  # (3, N)
        ids = _candidates(points, scales, opacities, lens)

        # Candidates in float64: far from the camera, x and y are small sums of large products, and
        # depths differ little.
        directions = means.index_select(0, ids).double() - centre
        exact = wide @ directions.T
        points = exact.to(means.dtype)
        rz = points[2].reciprocal()
        slopes = points[:2] * rz
        unit, inverse_length = unit_rows(quats.index_select(0, ids).T.contiguous())
        std = scales.index_select(0, ids).T.contiguous()
        meaningful = (std >= 0).all(0)
        std = torch.minimum(std, points[2] * longest_reach(std.dtype, lens))
        shape = _shape(slopes, rz, unit, std, view, lens)

        p1 = shape.p1
        p2 = shape.p2
        xx = (p1 * p1).sum(0)
        yy = (p2 * p2).sum(0)
        xy = (p1 * p2).sum(0)
        cross = _cross(p1, p2)
        det0 = cross[0].square().add_(cross[1].square()).add_(cross[2].square())
        det = det0 + lens.eps2d * (xx + yy) + lens.eps2d * lens.eps2d
        xx += lens.eps2d
        yy += lens.eps2d
        ratio = det0 / det
        alphas = opacities.index_select(0, ids)
        if lens.antialiased:
            alphas = alphas * ratio.clamp_min(COMPENSATION_MIN**2).sqrt()

        mx = slopes[0] * lens.fx + lens.cx
        my = slopes[1] * lens.fy + lens.cy
        radii = 3.0 * (0.5 * (xx + yy) + (0.25 * (xx - yy) ** 2 + xy * xy).sqrt()).sqrt()
        # squared Mahalanobis distance of the 1/255 ellipse
        level = 2.0 * (alphas / ALPHA_MIN).log()
        half_x = (level * xx).clamp_min(0).sqrt()
        half_y = (level * yy).clamp_min(0).sqrt()
        keep = (
            meaningful
            & (level > 0)
            & (level < torch.inf)
            & det.isfinite()
            & (det > 0)
            & (radii > lens.radius_clip)
        )
        keep &= mx.isfinite() & my.isfinite() & (points[2] > lens.near) & (points[2] < lens.far)
        keep &= (mx + half_x >= 0.5) & (mx - half_x <= lens.width - 0.5)
        keep &= (my + half_y >= 0.5) & (my - half_y <= lens.height - 0.5)
        kept = keep.nonzero()[:, 0]

        ids = ids.index_select(0, kept)
        rows = torch.stack([mx, my, points[2], xx, xy, yy, det, alphas, radii]).index_select(
            1, kept
        )
        directions = directions.index_select(0, kept).to(means.dtype)
        exact_depths = exact[2].index_select(0, kept)
        depth_keys = (exact_depths - exact_depths.amin() if len(kept) else exact_depths).to(
            means.dtype
        )
        ctx.lens = lens
        ctx.count = means.shape[0]
        if any(ctx.needs_input_grad):
            state = torch.cat([slopes, rz[None], unit, inverse_length[None], std, ratio[None]])
            ctx.save_for_backward(ids, state.index_select(1, kept), directions, view, opacities)
        radii = rows[8].ceil().clamp_max_(2**30).to(torch.int32)
        ctx.mark_non_differentiable(ids, radii, depth_keys)
        cov2d = rows[3:6].T.contiguous()
        return (
            ids,
            rows[:2].T.contiguous(),
            rows[2],
            cov2d,
            rows[6],
            rows[7],
            directions,
            radii,
            depth_keys,
        )

    @staticmethod
    @once_differentiable
    @full_precision
    def backward(
        ctx, _ids, grad_means2d, grad_depths, grad_cov2d, grad_det, grad_alphas, grad_directions, *_
    ):
        ids, state, directions, view, opacities = ctx.saved_tensors
        lens = ctx.lens
        slopes, rz, unit, inverse_length, std, ratio = state.split([2, 1, 4, 1, 3, 1])
        rz = rz[0]
        shape = _shape(slopes, rz, unit, std, view, lens)
        p1 = shape.p1
        p2 = shape.p2
        gxx, gxy, gyy = grad_cov2d.T.contiguous()

        # det = det0 + blur, with blur = eps2d (|p1|^2 + |p2|^2 + eps2d)
        cross = _cross(p1, p2)
        grad_det0 = grad_det
        if lens.antialiased:
            ratio = ratio[0]
            compensation = ratio.clamp_min(COMPENSATION_MIN**2).sqrt()
            grad_ratio = 0.5 * grad_alphas * opacities.index_select(0, ids) / compensation
            grad_ratio = grad_ratio * (ratio > COMPENSATION_MIN**2)
            grad_alphas = grad_alphas * compensation
            det0 = cross[0].square() + cross[1].square() + cross[2].square()
            blur = lens.eps2d * ((p1 * p1).sum(0) + (p2 * p2).sum(0) + lens.eps2d)
            det = det0 + blur
            # 1 - det0 / det as blur / det, because the difference cancels if the Gaussian is large
            grad_det0 = grad_det + grad_ratio / det * (blur / det)
            grad_det = grad_det - grad_ratio * ratio / det
        normal = torch.stack(cross) * (2 * grad_det0)
        gxx = 2 * (gxx + lens.eps2d * grad_det)
        gyy = 2 * (gyy + lens.eps2d * grad_det)
        grad_p1 = torch.addcmul(p1 * gxx, p2, gxy).add_(torch.stack(_cross(p2, normal)))
        grad_p2 = torch.addcmul(p2 * gyy, p1, gxy).sub_(torch.stack(_cross(p1, normal)))

        # P = reach (R^T a), with reach = f s / z
        grad_jx = grad_p1 * (lens.fx * rz)
        grad_jy = grad_p2 * (lens.fy * rz)
        grad_std = (shape.turned_a * grad_jx).addcmul_(shape.turned_b, grad_jy)
        # clamped axes do not depend on the scale
        grad_std *= std * rz < longest_reach(std.dtype, lens) * (1 - 1e-6)
        grad_log_rz = (std * grad_std).sum(0)
        grad_turned_a = grad_jx.mul_(std)
        grad_turned_b = grad_jy.mul_(std)
        grad_unit = _rotation_backward(unit, shape.a, grad_turned_a, shape.b, grad_turned_b)
        transposed = shape.rotation.transpose(0, 1)
        grad_a = _times(transposed, grad_turned_a)
        grad_b = _times(transposed, grad_turned_b)

        # x / z and y / z: in the image position and, unless clamped, in the Jacobian
        (low_x, high_x), (low_y, high_y) = lens.clamps()
        gx, gy = grad_means2d.T
        grad_u = lens.fx * gx - (view[2] @ grad_a) * ((slopes[0] >= low_x) & (slopes[0] <= high_x))
        grad_v = lens.fy * gy - (view[2] @ grad_b) * ((slopes[1] >= low_y) & (slopes[1] <= high_y))
        along = slopes[0] * grad_u + slopes[1] * grad_v + grad_log_rz
        grad_points = torch.stack([rz * grad_u, rz * grad_v, grad_depths - rz * along])
        grad_directions = grad_directions + (view.T @ grad_points).T

        grad_view = grad_centre = None
        if ctx.needs_input_grad[4]:
            tx = slopes[0].clamp(low_x, high_x)
            ty = slopes[1].clamp(low_y, high_y)
            grad_view = grad_points @ directions
            grad_view += torch.stack([grad_a.sum(1), grad_b.sum(1), -(grad_a @ tx) - (grad_b @ ty)])
            grad_view = grad_view.to(device="cpu", dtype=torch.float64)
        if ctx.needs_input_grad[5]:
            grad_centre = -grad_directions.sum(0, dtype=torch.float64).cpu()

        # a unit quaternion has no gradient along itself
        grad_unit = grad_unit - unit * (unit * grad_unit).sum(0)
        largest = torch.finfo(unit.dtype).max
        grad_quats = (grad_unit * inverse_length).clamp_(-largest, largest)

        def spread(values: Tensor) -> Tensor:
            return values.new_zeros(ctx.count, *values.shape[1:]).index_copy_(0, ids, values)

        return (
            spread(grad_directions),
            spread(grad_quats.T.contiguous()),
            spread(grad_std.T.contiguous()),
            spread(grad_alphas),
            grad_view,
            grad_centre,
            None,
        )
