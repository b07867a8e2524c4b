"""Colours by compiled kernels (``colors.cpp``), as :mod:`~pointsplat_ns.rasterizer.spherical_harmonics` makes them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.system.kernels import KERNELS, SEVERAL, Struct, on_threads


class CompiledColor(torch.autograd.Function):
    """As :class:`~pointsplat_ns.rasterizer.spherical_harmonics.Color`, of coefficients (N, K, 3) or, where ``rest`` is
    given, of the first (N, 3) and the others (N, K - 1, 3), which then need not be brought together."""

    @staticmethod
    def forward(ctx, directions, coefficients, rest, ids, degree):
        directions, coefficients, ids = (t.contiguous() for t in (directions, coefficients, ids))
        rest = None if rest is None else rest.contiguous()
        if len(ids):
            first, last = ids.aminmax()
            if first < 0 or last >= len(coefficients):
                raise IndexError(f"ids are from {first} to {last}; expected rows of {len(coefficients)} Gaussians")
        colors = torch.empty_like(directions)
        _call(_task(directions, coefficients, rest, ids, degree, colors))
        ctx.degree = degree
        ctx.save_for_backward(directions, coefficients, rest, ids, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        directions, coefficients, rest, ids, colors = ctx.saved_tensors
        task = _task(directions, coefficients, rest, ids, ctx.degree, colors)
        grad_directions = grad_coefficients = grad_rest = None
        if ctx.needs_input_grad[0] and ctx.degree:  # a constant has no direction
            grad_directions = torch.empty_like(directions)
        if ctx.needs_input_grad[1]:
            grad_coefficients = _zeros_like(coefficients)
        if ctx.needs_input_grad[2]:
            grad_rest = _zeros_like(rest)
        first, others = (None, None) if grad_coefficients is None else _pointers(grad_coefficients, None)
        task.fill(
            grad_colors=grad.contiguous(), grad_directions=grad_directions, grad_first=first,
            grad_rest=others if rest is None else grad_rest,
        )  # fmt: skip
        _call(task)
        return grad_directions, grad_coefficients, grad_rest, None, None


def _zeros_like(coefficients: Tensor) -> Tensor:
    """By NumPy, which takes memory that the system has zeroed: rows that are not seen are not written, nor paid for."""
    return torch.from_numpy(np.zeros(coefficients.shape, np.float32))


def _pointers(coefficients: Tensor, rest: Tensor | None) -> tuple[int, int]:
    """Addresses of the first coefficients and of the others."""
    first = coefficients.data_ptr()
    return first, first + 3 * coefficients.element_size() if rest is None else rest.data_ptr()


def _task(
    directions: Tensor, coefficients: Tensor, rest: Tensor | None, ids: Tensor, degree: int, colors: Tensor
) -> Struct:
    """A task without its gradients."""
    first, others = _pointers(coefficients, rest)
    return KERNELS.structs["Colors"](
        directions=directions, first=first, rest=others, first_row=coefficients[:1].numel(),
        rest_row=(coefficients if rest is None else rest)[:1].numel(), ids=ids, count=len(ids), degree=degree,
        colors=colors,
    )  # fmt: skip


def _call(task: Struct) -> None:
    on_threads(task.count >= SEVERAL, KERNELS.library.pointsplat_color, task)
