"""Projection by compiled kernels (``projection.cpp``): what :mod:`~pointsplat_ns.rasterizer.ewa` does in torch.

For float32 on a CPU, where the machine has a C++ compiler.
"""

from __future__ import annotations

import ctypes
import math
from pathlib import Path

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.rasterizer import ewa
from pointsplat_ns.rasterizer.constants import ALPHA_MIN, COMPENSATION_MIN
from pointsplat_ns.rasterizer.ewa import Lens
from pointsplat_ns.system.kernels import Kernels, agreement, on_threads

_SEVERAL = 4
"""Ranges of Gaussians from which on more than one thread is asked."""


class _Camera(ctypes.Structure):
    """``struct Camera`` of the kernels."""

    _fields_ = (
        ("view", ctypes.c_double * 9),
        ("centre", ctypes.c_double * 3),
        ("near_view", ctypes.c_float * 9),
        *(
            (name, ctypes.c_float)
            for name in (
                *("fx", "fy", "cx", "cy", "width", "height", "near_plane", "far_plane", "radius_clip", "eps2d"),
                *("alpha_min", "least_ratio", "steepness", "longest", "low_x", "high_x", "low_y", "high_y"),
            )
        ),
        ("antialiased", ctypes.c_int64),
    )

    @classmethod
    def of(cls, view: Tensor, centre: Tensor, lens: Lens) -> _Camera:
        """From a rotation (3, 3) and a centre (3,), both float64."""
        rotation, steepness = [value for row in view.tolist() for value in row], lens.steepness()
        (low_x, high_x), (low_y, high_y) = lens.clamp_x(), lens.clamp_y()
        return cls(
            view=tuple(rotation), centre=tuple(centre.tolist()), near_view=tuple(rotation),
            fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy, width=lens.width, height=lens.height,
            near_plane=lens.near, far_plane=lens.far, radius_clip=lens.radius_clip, eps2d=lens.eps2d,
            alpha_min=ALPHA_MIN, least_ratio=COMPENSATION_MIN**2, steepness=steepness,
            longest=ewa.longest_axis(torch.float32) / steepness,
            low_x=low_x, high_x=high_x, low_y=low_y, high_y=high_y, antialiased=int(lens.antialiased),
        )  # fmt: skip


class _Scene(ctypes.Structure):
    """``struct Scene`` of the kernels. It keeps none of the tensors alive."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities")),
        ("count", ctypes.c_int64),
    )

    @classmethod
    def of(cls, *tensors: Tensor) -> _Scene:
        return cls(*(tensor.data_ptr() for tensor in tensors), tensors[0].shape[0])


class _Projection(ctypes.Structure):
    """``struct Projection`` of the kernels."""

    _fields_ = (
        ("camera", _Camera),
        ("scene", _Scene),
        *((name, ctypes.c_void_p) for name in ("seen", "counts", "nearest", "offsets", "ids")),
        *((name, ctypes.c_void_p) for name in ("means2d", "depths", "cov2d", "dets", "opacities", "directions")),
        *((name, ctypes.c_void_p) for name in ("beyond", "radii", "next")),
    )


class _Gradient(ctypes.Structure):
    """``struct ProjectionGradient`` of the kernels."""

    _fields_ = (
        ("camera", _Camera),
        ("scene", _Scene),
        ("ids", ctypes.c_void_p),
        ("seen", ctypes.c_int64),
        *((f"grad_{name}", ctypes.c_void_p) for name in ("means2d", "depths", "cov2d", "det")),
        *((f"grad_{name}", ctypes.c_void_p) for name in ("opacities", "directions")),
        *((name, ctypes.c_void_p) for name in ("means", "quats", "scales", "opacities", "sums", "next")),
    )


def can_project(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, wanted: bool | None) -> bool:
    """Whether the kernels project these Gaussians.

    Args:
        means, quats, scales, opacities: of N Gaussians.
        wanted: None where a machine without a compiler is no reason for a warning.
    """
    return KERNELS.usable_for(wanted, means, quats, scales, opacities)


def count_meaningless(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> int:
    """As :func:`~pointsplat_ns.rasterizer.projection.count_meaningless`."""
    library = KERNELS.library
    tensors = [tensor.contiguous() for tensor in (means, quats, scales, opacities)]
    ranges = -(-len(means) // library.pointsplat_range())
    counts, next_range = torch.empty(ranges, dtype=torch.int64), torch.zeros(1, dtype=torch.int64)
    on_threads(
        ranges >= _SEVERAL, library.pointsplat_count_meaningless, ctypes.byref(_Scene.of(*tensors)), counts.data_ptr(),
        next_range.data_ptr(),
    )  # fmt: skip
    return int(counts.sum())


class CompiledProject(torch.autograd.Function):
    """As :class:`~pointsplat_ns.rasterizer.ewa.Project`."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, view, centre, lens: Lens):
        library = KERNELS.library
        scene = [tensor.contiguous() for tensor in (means, quats, scales, opacities)]
        count = means.shape[0]
        ranges = -(-count // library.pointsplat_range())
        counts, nearest = torch.empty(ranges, dtype=torch.int64), torch.empty(ranges, dtype=torch.float64)
        seen = torch.empty(count, library.pointsplat_seen(), dtype=torch.uint8)
        next_range = torch.zeros(1, dtype=torch.int64)
        camera = _Camera.of(view, centre, lens)
        task = _Projection(
            camera=camera, scene=_Scene.of(*scene), seen=seen.data_ptr(),
            counts=counts.data_ptr(), nearest=nearest.data_ptr(), next=next_range.data_ptr(),
        )  # fmt: skip
        on_threads(ranges >= _SEVERAL, library.pointsplat_project, ctypes.byref(task))

        offsets = torch.zeros(ranges + 1, dtype=torch.int64)
        torch.cumsum(counts, 0, out=offsets[1:])
        kept = int(offsets[-1])
        ids = torch.empty(kept, dtype=torch.int64)
        means2d, cov2d, directions = (means.new_empty(kept, columns) for columns in (2, 3, 3))
        depths, det, alphas, beyond = (means.new_empty(kept) for _ in range(4))
        radii = torch.empty(kept, dtype=torch.int32)
        task.offsets, task.ids, task.radii = offsets.data_ptr(), ids.data_ptr(), radii.data_ptr()
        task.means2d, task.depths, task.cov2d = means2d.data_ptr(), depths.data_ptr(), cov2d.data_ptr()
        task.dets, task.opacities, task.directions = det.data_ptr(), alphas.data_ptr(), directions.data_ptr()
        task.beyond = beyond.data_ptr()
        next_range.zero_()
        if kept:
            on_threads(ranges >= _SEVERAL, library.pointsplat_unpack, ctypes.byref(task))
        if any(ctx.needs_input_grad):
            ctx.camera = camera
            ctx.save_for_backward(ids, *scene)
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(ids, radii, beyond)
        return ids, means2d, depths, cov2d, det, alphas, directions, radii, beyond

    @staticmethod
    @once_differentiable
    def backward(ctx, _ids, *grads_and_more):
        library = KERNELS.library
        ids, *scene = ctx.saved_tensors
        grads = [None if grad is None else grad.contiguous() for grad in grads_and_more[:6]]
        out = [torch.empty_like(t) if n else None for t, n in zip(scene, ctx.needs_input_grad, strict=False)]
        ranges = -(-scene[0].shape[0] // library.pointsplat_range())
        of_camera = any(ctx.needs_input_grad[4:6])
        # Of the camera's rotation by rows, then of its centre.
        sums = torch.empty(ranges, 12, dtype=torch.float64) if of_camera else None
        next_range = torch.zeros(1, dtype=torch.int64)

        def pointer(tensor: Tensor | None) -> int | None:
            return None if tensor is None else tensor.data_ptr()

        task = _Gradient(
            ctx.camera, _Scene.of(*scene), ids.data_ptr(), len(ids),
            *map(pointer, grads), *map(pointer, out), pointer(sums), next_range.data_ptr(),
        )  # fmt: skip
        on_threads(ranges >= _SEVERAL, library.pointsplat_project_backward, ctypes.byref(task))
        grad_view = grad_centre = None
        if sums is not None:
            # by NumPy: on one thread, so that it is rounded alike on any number of them
            total = torch.from_numpy(sums.numpy().sum(0))
            grad_view, grad_centre = total[:9].view(3, 3), total[9:]
        return *out, grad_view, grad_centre, None


def _as_torch() -> bool:
    """Whether the kernels project some Gaussians, with gradients, as torch does."""
    generator = torch.Generator().manual_seed(0)
    count, size = 90, 40

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    means = random(count, 3) * 1.5 + torch.tensor([0.0, 0.0, 2.0])
    scene = means, random(count, 4), (0.8 * random(count, 3) - 2.0).exp(), random(count).sigmoid()
    view, centre = torch.linalg.qr(random(3, 3).double() * 0.2 + torch.eye(3).double())[0], 0.1 * random(3).double()
    lens = Lens(30.0, 32.0, 18.0, 21.0, size, size, 0.01, 1e10, 0.0, 0.3, True)
    projected = []
    for function in (ewa.Project, CompiledProject):
        with torch.enable_grad():
            leaves = [value.clone().requires_grad_() for value in (*scene, view * view[2, 2].sign(), centre)]
            ids, *values, radii, beyond = function.apply(*leaves, lens)
            total = sum((value / (1.0 + value.detach().abs())).sum() for value in values)
        grads = torch.autograd.grad(total, leaves)
        projected.append((ids, [*(value.detach() for value in values), radii.float(), beyond, *grads]))
    (torchs_ids, torchs), (our_ids, ours) = projected
    spoilt = [value.clone() for value in scene]
    for row, (value, wrong) in enumerate(zip(spoilt, (math.nan, math.inf, -1.0, -1.0), strict=True)):
        value[row] = wrong
    counted = count_meaningless(*scene) == 0 and count_meaningless(*spoilt) == len(spoilt)
    return counted and torch.equal(our_ids, torchs_ids) and agreement(ours, torchs, off=1e-4, share=1e-2)


KERNELS = Kernels(
    "the rasterizer",
    Path(__file__).with_name("projection.cpp"),
    {
        **dict.fromkeys(("pointsplat_project", "pointsplat_unpack", "pointsplat_project_backward"), [ctypes.c_void_p]),
        "pointsplat_count_meaningless": [ctypes.c_void_p] * 3,
    },
    _as_torch,
)
