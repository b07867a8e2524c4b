"""Colours by compiled kernels (``colors.cpp``), as :mod:`~pointsplat_ns.rasterizer.spherical_harmonics` makes them.

For float32 on a CPU, where the machine has a C++ compiler.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.rasterizer.spherical_harmonics import Color
from pointsplat_ns.system.kernels import Kernels, agreement, on_threads

_SEVERAL = 4000
"""Gaussians from which on more than one thread is asked."""


class _Colors(ctypes.Structure):
    """``struct Colors`` of the kernels."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("directions", "coefficients", "ids")),
        *((name, ctypes.c_int64) for name in ("count", "stored", "degree")),
        *((name, ctypes.c_void_p) for name in ("colors", "grad_colors", "grad_directions", "grad_coefficients")),
        ("next", ctypes.c_void_p),
    )


def can_color(directions: Tensor, coefficients: Tensor, wanted: bool | None) -> bool:
    """Whether the kernels compute the colours of these coefficients along these directions.

    Args:
        directions: (M, 3)
        coefficients: (N, K, 3)
        wanted: None where a machine without a compiler is no reason for a warning.
    """
    suited = all(tensor.dtype == torch.float32 and tensor.device.type == "cpu" for tensor in (directions, coefficients))
    return suited and KERNELS.usable(wanted)


class CompiledColor(torch.autograd.Function):
    """As :class:`~pointsplat_ns.rasterizer.spherical_harmonics.Color`."""

    @staticmethod
    def forward(ctx, directions, coefficients, ids, degree):
        directions, coefficients, ids = (t.contiguous() for t in (directions, coefficients, ids))
        if len(ids):
            first, last = ids.aminmax()
            if first < 0 or last >= len(coefficients):
                raise IndexError(f"ids are from {first} to {last}; expected rows of {len(coefficients)} Gaussians")
        colors = torch.empty_like(directions)
        _call(_task(directions, coefficients, ids, degree, colors))
        ctx.degree = degree
        ctx.save_for_backward(directions, coefficients, ids, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        directions, coefficients, ids, colors = ctx.saved_tensors
        grad = grad.contiguous()
        task = _task(directions, coefficients, ids, ctx.degree, colors)
        task.grad_colors = grad.data_ptr()
        grad_directions = grad_coefficients = None
        if ctx.needs_input_grad[0] and ctx.degree:  # a constant has no direction
            grad_directions = torch.empty_like(directions)
            task.grad_directions = grad_directions.data_ptr()
        if ctx.needs_input_grad[1]:
            # NumPy takes memory that the system has zeroed: rows that are not seen are not written, nor paid for
            grad_coefficients = torch.from_numpy(np.zeros(coefficients.shape, np.float32))
            task.grad_coefficients = grad_coefficients.data_ptr()
        _call(task)
        return grad_directions, grad_coefficients, None, None


def _task(directions: Tensor, coefficients: Tensor, ids: Tensor, degree: int, colors: Tensor) -> _Colors:
    """A task without its gradients. It keeps none of the tensors alive."""
    return _Colors(
        directions=directions.data_ptr(), coefficients=coefficients.data_ptr(), ids=ids.data_ptr(), count=len(ids),
        stored=coefficients.shape[1], degree=degree, colors=colors.data_ptr(),
    )  # fmt: skip


def _call(task: _Colors) -> None:
    next_range = torch.zeros(1, dtype=torch.int64)
    task.next = next_range.data_ptr()
    on_threads(task.count >= _SEVERAL, KERNELS.library.pointsplat_color, ctypes.byref(task))


def _as_torch() -> bool:
    """Whether the kernels give the colours of some coefficients, with gradients, as torch does."""
    generator = torch.Generator().manual_seed(0)
    coefficients, ids = torch.randn(60, 17, 3, generator=generator), torch.arange(0, 60, 2)
    directions, weights = (torch.randn(30, 3, generator=generator) for _ in range(2))
    for degree in range(4):
        colored = []
        for function in (Color, CompiledColor):
            with torch.enable_grad():
                leaves = [directions.clone().requires_grad_(degree > 0), coefficients.clone().requires_grad_()]
                colors = function.apply(*leaves, ids, degree)
            grads = torch.autograd.grad((colors * weights).sum(), leaves[degree == 0 :])
            colored.append((colors.detach(), *grads))
        if not agreement(colored[1], colored[0], off=1e-5, share=1e-2):
            return False
    return True


KERNELS = Kernels(
    "the rasterizer",
    Path(__file__).with_name("colors.cpp"),
    {"pointsplat_color": [ctypes.c_void_p]},
    _as_torch,
)
