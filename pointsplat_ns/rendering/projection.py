"""Projects 3D Gaussians to 2D Gaussians in the image of one pinhole camera (EWA splatting)."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.rendering.constants import ALPHA_MIN, COMPENSATION_MIN
from pointsplat_ns.rendering.ewa import Lens, Project, longest_axis
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import EPS2D, View, Views
from pointsplat_ns.system.kernels import (
    ANY_POINTER,
    DOUBLE_POINTER,
    FLOAT_POINTER,
    INT64_POINTER,
    KERNELS,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.tensors import DOUBLES, FLOATS, INDICES


class CameraStruct(Struct):
    """``Camera`` of ``camera.h``, which documents its members."""

    members = {
        "view": ctypes.c_double * 9,
        "centre": ctypes.c_double * 3,
        "near_view": ctypes.c_float * 9,
        "fx": ctypes.c_float,
        "fy": ctypes.c_float,
        "cx": ctypes.c_float,
        "cy": ctypes.c_float,
        "width": ctypes.c_float,
        "height": ctypes.c_float,
        "near_plane": ctypes.c_float,
        "far_plane": ctypes.c_float,
        "radius_clip": ctypes.c_float,
        "eps2d": ctypes.c_float,
        "alpha_min": ctypes.c_float,
        "least_ratio": ctypes.c_float,
        "steepness": ctypes.c_float,
        "longest": ctypes.c_float,
        "low_x": ctypes.c_float,
        "high_x": ctypes.c_float,
        "low_y": ctypes.c_float,
        "high_y": ctypes.c_float,
        "antialiased": ctypes.c_int64,
    }
    _fields_ = c_fields(members)


class SceneStruct(Struct):
    """``Scene`` of ``camera.h``, which documents its members."""

    members = {
        "means": FLOAT_POINTER,
        "quats": FLOAT_POINTER,
        "scales": FLOAT_POINTER,
        "opacities": FLOAT_POINTER,
        "count": ctypes.c_int64,
    }
    _fields_ = c_fields(members)


class ProjectionStruct(Struct):
    """``Projection`` of ``projection.cpp``, which documents its members."""

    members = {
        "camera": CameraStruct,
        "scene": SceneStruct,
        "seen": ANY_POINTER,
        "counts": INT64_POINTER,
    }
    _fields_ = c_fields(members)


class ProjectionGradientStruct(Struct):
    """``ProjectionGradient`` of ``projection.cpp``, which documents its members."""

    members = {
        "camera": CameraStruct,
        "scene": SceneStruct,
        "ids": INT64_POINTER,
        "seen": ctypes.c_int64,
        "grad_means2d": FLOAT_POINTER,
        "grad_depths": FLOAT_POINTER,
        "grad_cov2d": FLOAT_POINTER,
        "grad_det": FLOAT_POINTER,
        "grad_opacities": FLOAT_POINTER,
        "grad_directions": FLOAT_POINTER,
        "means": FLOAT_POINTER,
        "quats": FLOAT_POINTER,
        "scales": FLOAT_POINTER,
        "opacities": FLOAT_POINTER,
        "sums": DOUBLE_POINTER,
    }
    _fields_ = c_fields(members)


range_kernel = Function("pointsplat_range", result=ctypes.c_int64)
seen_kernel = Function("pointsplat_seen", result=ctypes.c_int64)
project_kernel = Function("pointsplat_project", ProjectionStruct, INT64_POINTER)
project_backward_kernel = Function(
    "pointsplat_project_backward", ProjectionGradientStruct, INT64_POINTER
)


@dataclass
class Projected:
    """The M Gaussians that a camera sees, packed."""

    ids: Tensor  # [M] int64, rows of the input, ascending
    means2d: Tensor  # [M, 2] pixels; the centre of the first pixel is (0.5, 0.5)
    depths: Tensor  # [M] along the optical axis
    cov2d: Tensor  # [M, 3] xx, xy, yy in pixels^2, with eps2d
    det: Tensor  # [M] determinant of cov2d
    opacities: Tensor  # [M] in (0, 1], with compensation
    directions: Tensor  # [M, 3] from the camera centre, world space
    radii: Tensor  # [M] int32, pixels, 3 standard deviations of the longest axis
    depth_keys: Tensor  # [M] depth minus that of the nearest; the sort key for drawing

    @property
    def conics(self) -> Tensor:
        """Inverse covariances, (M, 3): xx, xy, yy."""
        xx, xy, yy = self.cov2d.unbind(-1)
        return torch.stack([yy, -xy, xx], dim=-1) / self.det[:, None]

    def select(self, rows: Tensor) -> Projected:
        """A selection of the Gaussians, by rows (int64)."""
        return Projected(
            **{f.name: getattr(self, f.name).index_select(0, rows) for f in fields(self)}
        )


def camera_centre(viewmat: Tensor) -> Tensor:
    """Position of the camera in the world, (3,), from a matrix (4, 4) on the CPU in float64: the
    solution of ``R c = -t``.

    Solved instead of ``-R^T t``, because a rotation stored in float32 is orthogonal only to 1e-7,
    which a translation of 1e6 turns into a tenth of a unit. Raises ValueError if the matrix is not
    finite, its rotation cannot be inverted, or its last row is not 0, 0, 0, 1.
    """
    rows = viewmat.tolist()
    centre, singular = torch.linalg.solve_ex(viewmat[:3, :3], -viewmat[:3, 3])
    if int(singular) or not all(math.isfinite(value) for row in rows for value in row):
        raise ValueError(f"viewmat is {rows}; expected finite numbers and a rotation")
    if not _close(rows[3], (0.0, 0.0, 0.0, 1.0)):
        raise ValueError(
            f"viewmat has the last row {rows[3]}; expected 0, 0, 0, 1: a row-major "
            "world-to-camera matrix"
        )
    return centre


def _close(values: Sequence[float], wanted: Sequence[float]) -> bool:
    """Whether camera numbers have the expected values, up to the rounding of inversion."""
    return all(abs(value - right) <= 1e-5 for value, right in zip(values, wanted, strict=True))


@torch.no_grad()
def count_meaningless(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> int:
    """Number of Gaussians (N, ...) that no camera can draw: a NaN or infinite parameter, a negative
    scale or opacity."""
    # a NaN or Inf makes a sum NaN or Inf, so a clean scene costs four sums and one transfer
    total = means.sum() + quats.sum() + scales.sum() + opacities.sum()
    if bool(total.isfinite() & ~(scales < 0).any() & ~(opacities < 0).any()):
        return 0
    good = (scales >= 0).all(-1) & (opacities >= 0)
    for values in (means, quats, scales, opacities[:, None]):
        good &= values.isfinite().all(-1)
    return means.shape[0] - int(good.sum())


def drawn_antialiased(scene: Gaussians, view: View | Views) -> bool:
    """Whether an image is antialiased: if the scene or the view is."""
    return scene.antialiased or view.rasterize_mode == "antialiased"


def project_scene(scene: Gaussians, view: View) -> Projected:
    """Project a scene to a view, as in :func:`~pointsplat_ns.render`, on the scene's device."""
    return project(scene.means, scene.quats, scene.stds, scene.alphas, camera_to(scene, view))


class Camera(NamedTuple):
    """A pinhole camera, on the CPU in float64, where its few numbers are computed.

    float32 would move a camera that is far from the origin. On a GPU, reading each number would
    wait for all earlier work, and torch's linear algebra must not be initialised there from several
    threads at once.
    """

    rotation: Tensor  # [3, 3] world to camera
    centre: Tensor  # [3] in the world
    lens: Lens


def camera_to(scene: Gaussians, view: View) -> Camera:
    """The camera that draws a scene from a view."""
    return camera_of(
        view.viewmat,
        view.K,
        view.width,
        view.height,
        near_plane=view.near_plane,
        far_plane=math.inf,
        eps2d=view.eps2d,
        antialiased=drawn_antialiased(scene, view),
    )


def camera_of(
    # [4, 4] world to camera, OpenCV axes; on any device, which also receives its gradient
    viewmat: Tensor,
    K: Tensor,  # [3, 3]; on any device
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = EPS2D,
    antialiased: bool = False,
) -> Camera:
    """The camera of these matrices. Arguments are those of :func:`~pointsplat_ns.rasterization`;
    raises ValueError if a focal length is zero, or the camera is not finite, has skew or is not a
    rigid motion."""
    viewmat, K = (matrix.to(device="cpu", dtype=torch.float64) for matrix in (viewmat, K))
    # R (m - c) instead of R m + t: far from the origin it rounds alike for all Gaussians
    centre = camera_centre(viewmat)
    (fx, skew, cx), (below, fy, cy), last = K.tolist()
    if not all(map(math.isfinite, (fx, fy, cx, cy))) or fx == 0 or fy == 0:
        raise ValueError(
            f"K has fx {fx}, fy {fy}, cx {cx}, cy {cy}; expected finite numbers and focal lengths "
            "other than 0"
        )
    if not _close((skew, below, *last), (0.0, 0.0, 0.0, 0.0, 1.0)):
        raise ValueError(
            f"K is {K.tolist()}; expected no skew: zeros except for fx, fy, cx, cy and the 1 in "
            "the last row"
        )
    lens = Lens(
        fx, fy, cx, cy, width, height, near_plane, far_plane, radius_clip, eps2d, antialiased
    )
    return Camera(viewmat[:3, :3], centre, lens)


def camera_struct(view: Tensor, centre: Tensor, lens: Lens) -> CameraStruct:
    """The :class:`Camera` as a struct for kernels."""
    rotation = tuple(view.flatten().tolist())
    steepness = lens.steepness()
    (low_x, high_x), (low_y, high_y) = lens.clamps()
    return CameraStruct(
        view=rotation,
        centre=tuple(centre.tolist()),
        near_view=rotation,
        fx=lens.fx,
        fy=lens.fy,
        cx=lens.cx,
        cy=lens.cy,
        width=lens.width,
        height=lens.height,
        near_plane=lens.near,
        far_plane=lens.far,
        radius_clip=lens.radius_clip,
        eps2d=lens.eps2d,
        alpha_min=ALPHA_MIN,
        least_ratio=COMPENSATION_MIN**2,
        steepness=steepness,
        longest=longest_axis(torch.float32) / steepness,
        low_x=low_x,
        high_x=high_x,
        low_y=low_y,
        high_y=high_y,
        antialiased=int(lens.antialiased),
    )


def scene_struct(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> Struct:
    """The Gaussians as a struct for kernels, from contiguous tensors."""
    return SceneStruct(
        means=means, quats=quats, scales=scales, opacities=opacities, count=len(means)
    )


def packed_rows(counts: Tensor) -> Tensor:
    """Rows of the visible Gaussians in the kernels' output, which are first in each range;
    ``counts`` (ranges,) int64."""
    before = torch.cumsum(counts, 0) - counts
    starts = range_kernel() * torch.arange(len(counts), **INDICES) - before
    return torch.arange(int(counts.sum()), **INDICES) + starts.repeat_interleave(counts)


def depths_behind_nearest(depths: Tensor) -> Tensor:
    """Depths (M,) float64 minus the minimum, as float32: the sort key for drawing."""
    return (depths - depths.amin() if len(depths) else depths).float()


class CompiledProject(torch.autograd.Function):
    """As :class:`~pointsplat_ns.rendering.ewa.Project`, by compiled kernels
    (``compiled/projection.cpp``)."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, view, centre, lens: Lens):
        scene = [tensor.contiguous() for tensor in (means, quats, scales, opacities)]
        count = means.shape[0]
        counts = torch.empty(-(-count // range_kernel()), **INDICES)
        # each range starts at its first Gaussian
        seen = torch.empty(count, seen_kernel() // 4, **FLOATS)
        camera = camera_struct(view, centre, lens)
        task = ProjectionStruct(camera=camera, scene=scene_struct(*scene), seen=seen, counts=counts)
        on_threads(count >= SEVERAL, project_kernel, task)

        # fields of the struct Seen, in units of four bytes
        parts = seen.index_select(0, packed_rows(counts)).split([2, 2, 2, 1, 3, 1, 1, 3, 1], dim=1)
        exact, ids, means2d, depths, cov2d, det, alphas, directions, radii = (
            part.contiguous() for part in parts
        )
        exact = exact.view(torch.float64)
        ids = ids.view(torch.int64)[:, 0]
        radii = radii.view(torch.int32)[:, 0]
        depths = depths[:, 0]
        det = det[:, 0]
        alphas = alphas[:, 0]
        depth_keys = depths_behind_nearest(exact[:, 0])
        if any(ctx.needs_input_grad):
            ctx.camera = camera
            ctx.save_for_backward(ids, *scene)
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(ids, radii, depth_keys)
        return ids, means2d, depths, cov2d, det, alphas, directions, radii, depth_keys

    @staticmethod
    @once_differentiable
    def backward(ctx, _ids, *given):
        ids, *scene = ctx.saved_tensors
        wanted = zip(
            ("means", "quats", "scales", "opacities"), scene, ctx.needs_input_grad, strict=False
        )
        out = {
            name: torch.empty_like(tensor) if needed else None for name, tensor, needed in wanted
        }
        ranges = -(-scene[0].shape[0] // range_kernel())
        # gradients of the camera's rotation by rows, then of its centre
        sums = torch.empty(ranges, 12, **DOUBLES) if any(ctx.needs_input_grad[4:6]) else None
        names = (
            "grad_means2d",
            "grad_depths",
            "grad_cov2d",
            "grad_det",
            "grad_opacities",
            "grad_directions",
        )
        grads = {
            name: grad if grad is None else grad.contiguous()
            for name, grad in zip(names, given, strict=False)
        }
        task = ProjectionGradientStruct(
            camera=ctx.camera,
            scene=scene_struct(*scene),
            ids=ids,
            seen=len(ids),
            sums=sums,
            **grads,
            **out,
        )
        on_threads(len(scene[0]) >= SEVERAL, project_backward_kernel, task)
        grad_view = grad_centre = None
        if sums is not None:
            # NumPy sums on one thread, so the rounding does not depend on the number of threads
            total = torch.from_numpy(sums.numpy().sum(0))
            grad_view = total[:9].view(3, 3)
            grad_centre = total[9:]
        return *out.values(), grad_view, grad_centre, None


def project(
    means: Tensor,  # [N, 3] world
    quats: Tensor,  # [N, 4] wxyz, any length
    scales: Tensor,  # [N, 3] standard deviations
    opacities: Tensor,  # [N] in [0, 1]
    camera: Camera,
    compiled: bool | None = None,
) -> Projected:
    """Project the Gaussians that one camera sees, and drop the others.

    Dropped are Gaussians with a non-finite parameter or a negative scale, nearer than
    ``near_plane`` or farther than ``far_plane``, fainter than 1/255, or whose 1/255 ellipse misses
    every pixel centre. Differentiable in means, quats, scales, opacities and the camera's matrix.
    Runs in torch (:mod:`~pointsplat_ns.rendering.ewa`), or with compiled kernels if they were
    built; ``compiled`` is that of :func:`~pointsplat_ns.rasterization`.
    """
    suited = KERNELS.usable_for(compiled, means, quats, scales, opacities)
    function = CompiledProject if suited else Project
    return Projected(*function.apply(means, quats, scales, opacities, *camera))
