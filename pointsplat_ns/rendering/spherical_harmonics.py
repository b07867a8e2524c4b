"""Colours of Gaussians from real spherical harmonics up to degree 3, in torch or C++."""

from __future__ import annotations

import ctypes

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.geometry.harmonics import C1, C2, C3, SH_C0, basis_rows
from pointsplat_ns.geometry.transforms import unit_rows
from pointsplat_ns.system.kernels import (
    FLOAT_POINTER,
    INT64_POINTER,
    KERNELS,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.tensors import full_precision


class ColorsStruct(Struct):
    """``Colors`` of ``colors.cpp``, which says what its members are."""

    members = {
        "directions": FLOAT_POINTER,
        "first": FLOAT_POINTER,
        "rest": FLOAT_POINTER,
        "rest_row": ctypes.c_int64,
        "ids": INT64_POINTER,
        "count": ctypes.c_int64,
        "degree": ctypes.c_int64,
        "colors": FLOAT_POINTER,
        "grad_colors": FLOAT_POINTER,
        "grad_directions": FLOAT_POINTER,
        "grad_first": FLOAT_POINTER,
        "grad_rest": FLOAT_POINTER,
    }
    _fields_ = c_fields(members)


color_kernel = Function("pointsplat_color", ColorsStruct, INT64_POINTER)


def _basis_backward(unit: Tensor, grad: Tensor, degree: int) -> Tensor:
    """Gradient (3, M) of the unit direction, from the gradients ((degree + 1)^2, M) of the
    basis."""
    x, y, z = unit
    gx = -C1 * grad[3]
    gy = -C1 * grad[1]
    gz = C1 * grad[2]
    if degree >= 2:
        a = C2[0] * grad[4]
        b = C2[0] * grad[5]
        c = 2 * C2[1] * grad[6]
        d = C2[0] * grad[7]
        e = 2 * C2[2] * grad[8]
        gx += a * y - c * x - d * z + e * x
        gy += a * x - b * z - c * y - e * y
        gz += 2 * c * z - b * y - d * x
    if degree >= 3:
        xx = x * x
        yy = y * y
        zz = z * z
        xy = x * y
        xz = x * z
        yz = y * z
        h0 = C3[0] * grad[9]
        h6 = C3[0] * grad[15]
        h1 = C3[1] * grad[10]
        h3 = C3[3] * grad[12]
        h5 = C3[4] * grad[14]
        h2 = C3[2] * grad[11]
        h4 = C3[2] * grad[13]
        around = 4.0 * zz - xx - yy
        across = 3.0 * (xx - yy)
        gx += (
            h1 * yz
            - 6 * h0 * xy
            + 2 * h2 * xy
            - 6 * h3 * xz
            - h4 * (around - 2 * xx)
            + 2 * h5 * xz
            - h6 * across
        )
        gy += (
            h1 * xz
            - h0 * across
            - h2 * (around - 2 * yy)
            - 6 * h3 * yz
            + 2 * h4 * xy
            - 2 * h5 * yz
            + 6 * h6 * xy
        )
        gz += (
            h1 * xy
            - 8 * h2 * yz
            + h3 * (6.0 * zz - 3.0 * xx - 3.0 * yy)
            - 8 * h4 * xz
            + h5 * (xx - yy)
        )
    return torch.stack([gx, gy, gz])


def _blocks(count: int, on_cpu: bool) -> list[slice]:
    """Pieces of the work: on a CPU the coefficients of one piece stay in the cache, and are not
    copied as a whole."""
    # On a CPU 0.8 MB of coefficients per piece at degree 3.
    step = 4096 if on_cpu else max(count, 1)
    return [slice(start, min(start + step, count)) for start in range(0, count, step)]


def offset(color: Tensor) -> Tensor:
    """Add the 1/2 of 3DGS, and turn infinities into NaN, because the lower bound of 0 would hide
    them."""
    return (color - color) + (color + 0.5)


class Color(torch.autograd.Function):
    """Colours of selected rows of SH coefficients; see :func:`sh_to_color`."""

    @staticmethod
    def forward(ctx, directions, first, rest, ids, degree):
        unit, inverse_length = unit_rows(directions.T.contiguous())
        basis = torch.stack(basis_rows(unit, degree)).T.contiguous()
        color = directions.new_empty(directions.shape[0], 3)
        for part in _blocks(color.shape[0], color.device.type == "cpu"):
            torch.bmm(
                basis[part].unsqueeze(1),
                _rows(first, rest, ids[part], degree),
                out=color[part].unsqueeze(1),
            )
        color = offset(color)
        ctx.degree = degree
        ctx.save_for_backward(first, rest, unit, inverse_length, basis, color > 0, ids)
        return color.clamp_min_(0.0)

    @staticmethod
    @once_differentiable
    @full_precision
    def backward(ctx, grad):
        first, rest, unit, inverse_length, basis, positive, ids = ctx.saved_tensors
        grad = grad * positive
        grad_basis = torch.empty_like(basis) if ctx.needs_input_grad[0] else None
        grad_first = torch.zeros_like(first) if ctx.needs_input_grad[1] else None
        grad_rest = torch.zeros_like(rest) if ctx.needs_input_grad[2] else None
        for part in _blocks(basis.shape[0], basis.device.type == "cpu"):
            if grad_basis is not None:
                chosen = _rows(first, rest, ids[part], ctx.degree)
                torch.bmm(chosen, grad[part].unsqueeze(-1), out=grad_basis[part].unsqueeze(-1))
            rows = basis[part].unsqueeze(-1) * grad[part].unsqueeze(1)
            if grad_first is not None:
                grad_first.index_copy_(0, ids[part], rows[:, 0])
            if grad_rest is not None:
                grad_rest[:, : rows.shape[1] - 1].index_copy_(0, ids[part], rows[:, 1:])
        grad_directions = None
        if grad_basis is not None:
            grad_unit = _basis_backward(unit, grad_basis.T.contiguous(), ctx.degree)
            across = grad_unit - unit * (unit * grad_unit).sum(0)
            grad_directions = (across * inverse_length).T.contiguous()
        return grad_directions, grad_first, grad_rest, None, None


def _rows(first: Tensor, rest: Tensor, ids: Tensor, degree: int) -> Tensor:
    """The coefficients (m, (degree + 1)^2, 3) of the Gaussians ``ids`` (m,)."""
    others = rest.index_select(0, ids)[:, : (degree + 1) ** 2 - 1]
    return torch.cat([first.index_select(0, ids)[:, None], others], 1)


class CompiledColor(torch.autograd.Function):
    """As :class:`Color`, with compiled kernels (``compiled/colors.cpp``)."""

    @staticmethod
    def forward(ctx, directions, first, rest, ids, degree):
        directions, first, rest, ids = (
            tensor.contiguous() for tensor in (directions, first, rest, ids)
        )
        if len(ids):
            lowest, highest = ids.aminmax()
            if lowest < 0 or highest >= len(first):
                raise IndexError(
                    f"ids are from {lowest} to {highest}; expected rows of {len(first)} Gaussians"
                )
        colors = torch.empty_like(directions)
        _call_kernels(directions, first, rest, ids, degree, colors)
        ctx.degree = degree
        ctx.save_for_backward(directions, first, rest, ids, colors)
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, grad):
        directions, first, rest, ids, colors = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        # the constant basis function has no gradient by direction
        of_directions = torch.empty_like(directions) if wanted[0] and ctx.degree else None
        of_first = zeros_like(first) if wanted[1] else None
        of_rest = zeros_like(rest) if wanted[2] else None
        _call_kernels(
            directions,
            first,
            rest,
            ids,
            ctx.degree,
            colors,
            grad_colors=grad.contiguous(),
            grad_directions=of_directions,
            grad_first=of_first,
            grad_rest=of_rest,
        )
        return of_directions, of_first, of_rest, None, None


def zeros_like(coefficients: Tensor) -> Tensor:
    """Zeros from NumPy, which uses memory that the system zeroes lazily: rows of invisible
    Gaussians are never written and cost nothing."""
    return torch.from_numpy(np.zeros(coefficients.shape, np.float32))


def _call_kernels(
    directions: Tensor,
    first: Tensor,
    rest: Tensor,
    ids: Tensor,
    degree: int,
    colors: Tensor,
    **grads: Tensor | None,
) -> None:
    task = ColorsStruct(
        directions=directions,
        first=first,
        rest=rest,
        rest_row=3 * rest.shape[1],
        ids=ids,
        count=len(ids),
        degree=degree,
        colors=colors,
        **grads,
    )
    on_threads(len(ids) >= SEVERAL, color_kernel, task)


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Basis values (M, (degree + 1)^2) for unit directions (M, 3), world space, at degree 0 to
    3."""
    return torch.stack(basis_rows(directions.movedim(-1, 0), degree), dim=-1)


def sh_to_color(
    directions: Tensor,
    first: Tensor,
    rest: Tensor,
    degree: int,
    ids: Tensor,
    compiled: bool | None = None,
) -> Tensor:
    """Colours seen along directions, as defined by 3DGS: ``max(SH + 1/2, 0)``.

    Args:
        directions: (M, 3) from the camera centre to the Gaussian, world space, any length; a zero
            direction gives the basis at zero.
        first: (N, 3) constant SH coefficients.
        rest: (N, K - 1, 3) the others; K >= (degree + 1)^2, higher ones are ignored.
        degree: 0 to 3.
        ids: (M,) int64, distinct: row of the coefficients for each direction.
        compiled: as for :func:`~pointsplat_ns.rasterization`.

    Returns:
        (M, 3), at least 0; NaN if a coefficient is not finite.

    Raises:
        ValueError: if the degree is not 0 to 3, or there are too few coefficients.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"sh_degree is {degree}; expected 0 to 3")
    used = (degree + 1) ** 2
    stored = 1 + rest.shape[1]
    if stored < used:
        raise ValueError(f"{stored} SH coefficients given; degree {degree} needs {used}")
    if KERNELS.usable_for(compiled, directions, first, rest):
        # the constant basis function has no gradient by direction
        return CompiledColor.apply(
            directions if degree else directions.detach(), first, rest, ids, degree
        )
    if degree == 0:
        return offset(SH_C0 * first.index_select(0, ids)).clamp_min(0.0)
    return Color.apply(directions, first, rest, ids, degree)
