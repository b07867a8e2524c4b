"""Colours by compiled kernels (``colors.cpp``), as :mod:`~pointsplat_ns.rasterizer.spherical_harmonics` makes them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.system.kernels import KERNELS, SEVERAL, on_threads


class CompiledColor(torch.autograd.Function):
    """As :class:`~pointsplat_ns.rasterizer.spherical_harmonics.Color`."""

    @staticmethod
    def forward(ctx, directions, first, rest, ids, degree):
        directions, first, rest, ids = (tensor.contiguous() for tensor in (directions, first, rest, ids))
        if len(ids):
            lowest, highest = ids.aminmax()
            if lowest < 0 or highest >= len(first):
                raise IndexError(f"ids are from {lowest} to {highest}; expected rows of {len(first)} Gaussians")
        colors = torch.empty_like(directions)
        _call(directions, first, rest, ids, degree, colors)
        ctx.degree = degree
        ctx.save_for_backward(directions, first, rest, ids, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        directions, first, rest, ids, colors = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        # a constant has no direction
        of_directions = torch.empty_like(directions) if wanted[0] and ctx.degree else None
        of_first = _zeros_like(first) if wanted[1] else None
        of_rest = _zeros_like(rest) if wanted[2] else None
        _call(
            directions, first, rest, ids, ctx.degree, colors,
            grad_colors=grad.contiguous(), grad_directions=of_directions, grad_first=of_first, grad_rest=of_rest,
        )  # fmt: skip
        return of_directions, of_first, of_rest, None, None


def _zeros_like(coefficients: Tensor) -> Tensor:
    """By NumPy, which takes memory that the system has zeroed: rows that are not seen are not written, nor paid for."""
    return torch.from_numpy(np.zeros(coefficients.shape, np.float32))


def _call(
    directions: Tensor, first: Tensor, rest: Tensor, ids: Tensor, degree: int, colors: Tensor, **grads: Tensor | None
) -> None:
    task = KERNELS.structs["Colors"](
        directions=directions, first=first, rest=rest, rest_row=3 * rest.shape[1], ids=ids, count=len(ids),
        degree=degree, colors=colors, **grads,
    )  # fmt: skip
    on_threads(len(ids) >= SEVERAL, KERNELS.library.pointsplat_color, task)
