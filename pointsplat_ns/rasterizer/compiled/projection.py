"""Projection by compiled kernels (``projection.cpp``), as :mod:`~pointsplat_ns.rasterizer.ewa` does it in torch."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.rasterizer.constants import ALPHA_MIN, COMPENSATION_MIN
from pointsplat_ns.rasterizer.ewa import Lens, longest_axis
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, Struct, on_threads
from pointsplat_ns.system.tensors import DOUBLES, INDICES


def camera_struct(view: Tensor, centre: Tensor, lens: Lens) -> Struct:
    """The camera of kernels, from a rotation (3, 3) and a centre (3,), both float64."""
    rotation, steepness = tuple(view.flatten().tolist()), lens.steepness()
    (low_x, high_x), (low_y, high_y) = lens.clamp_x(), lens.clamp_y()
    return KERNELS.structs["Camera"](
        view=rotation, centre=tuple(centre.tolist()), near_view=rotation,
        fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy, width=lens.width, height=lens.height,
        near_plane=lens.near, far_plane=lens.far, radius_clip=lens.radius_clip, eps2d=lens.eps2d,
        alpha_min=ALPHA_MIN, least_ratio=COMPENSATION_MIN**2, steepness=steepness,
        longest=longest_axis(torch.float32) / steepness,
        low_x=low_x, high_x=high_x, low_y=low_y, high_y=high_y, antialiased=int(lens.antialiased),
    )  # fmt: skip


def scene_struct(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor) -> Struct:
    """The Gaussians of kernels, from contiguous tensors."""
    return KERNELS.structs["Scene"](means=means, quats=quats, scales=scales, opacities=opacities, count=len(means))


class CompiledProject(torch.autograd.Function):
    """As :class:`~pointsplat_ns.rasterizer.ewa.Project`."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, view, centre, lens: Lens):
        library = KERNELS.library
        scene = [tensor.contiguous() for tensor in (means, quats, scales, opacities)]
        count = means.shape[0]
        ranges = -(-count // library.pointsplat_range())
        counts, nearest = torch.empty(ranges, **INDICES), torch.empty(ranges, **DOUBLES)
        seen = torch.empty(count, library.pointsplat_seen(), dtype=torch.uint8, device="cpu")
        camera = camera_struct(view, centre, lens)
        task = KERNELS.structs["Projection"](
            camera=camera, scene=scene_struct(*scene), seen=seen, counts=counts, nearest=nearest
        )
        on_threads(count >= SEVERAL, library.pointsplat_project, task)

        offsets = torch.zeros(ranges + 1, **INDICES)
        torch.cumsum(counts, 0, out=offsets[1:])
        kept = int(offsets[-1])
        ids = torch.empty(kept, **INDICES)
        means2d, cov2d, directions = (means.new_empty(kept, columns) for columns in (2, 3, 3))
        depths, det, alphas, depth_keys = (means.new_empty(kept) for _ in range(4))
        radii = torch.empty(kept, dtype=torch.int32, device="cpu")
        task.fill(
            offsets=offsets, ids=ids, radii=radii, means2d=means2d, depths=depths, cov2d=cov2d, dets=det,
            opacities=alphas, directions=directions, depth_keys=depth_keys,
        )  # fmt: skip
        if kept:
            on_threads(count >= SEVERAL, library.pointsplat_unpack, task)
        if any(ctx.needs_input_grad):
            ctx.camera = camera
            ctx.save_for_backward(ids, *scene)
            ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(ids, radii, depth_keys)
        return ids, means2d, depths, cov2d, det, alphas, directions, radii, depth_keys

    @staticmethod
    @once_differentiable
    def backward(ctx, _ids, *given):
        library = KERNELS.library
        ids, *scene = ctx.saved_tensors
        wanted = zip(("means", "quats", "scales", "opacities"), scene, ctx.needs_input_grad, strict=False)
        out = {name: torch.empty_like(tensor) if needed else None for name, tensor, needed in wanted}
        ranges = -(-scene[0].shape[0] // library.pointsplat_range())
        # gradients of the camera's rotation by rows, then of its centre
        sums = torch.empty(ranges, 12, **DOUBLES) if any(ctx.needs_input_grad[4:6]) else None
        names = ("grad_means2d", "grad_depths", "grad_cov2d", "grad_det", "grad_opacities", "grad_directions")
        grads = {name: grad if grad is None else grad.contiguous() for name, grad in zip(names, given, strict=False)}
        task = KERNELS.structs["ProjectionGradient"](
            camera=ctx.camera, scene=scene_struct(*scene), ids=ids, seen=len(ids), sums=sums, **grads, **out
        )
        on_threads(len(scene[0]) >= SEVERAL, library.pointsplat_project_backward, task)
        grad_view = grad_centre = None
        if sums is not None:
            # NumPy sums on one thread, so the rounding does not depend on their number
            total = torch.from_numpy(sums.numpy().sum(0))
            grad_view, grad_centre = total[:9].view(3, 3), total[9:]
        return *out.values(), grad_view, grad_centre, None
