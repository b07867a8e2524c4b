"""Which Gaussian touches which tile, by compiled kernels (``tiles.cpp``), as :mod:`~pointsplat_ns.rasterizer.ellipses`
finds it.

For float32 on a CPU, where the machine has a C++ compiler.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.rasterizer import ellipses as in_torch
from pointsplat_ns.rasterizer.constants import ALPHA_MIN, SLACK
from pointsplat_ns.rasterizer.ellipses import Ellipses, Grid, Pairs, Region
from pointsplat_ns.system.kernels import Kernels, on_threads


class _Grid(ctypes.Structure):
    """``struct Grid`` of the kernels."""

    _fields_ = (*((name, ctypes.c_int64) for name in ("height", "rows", "columns")), ("slack", ctypes.c_float))

    @classmethod
    def of(cls, grid: Grid) -> _Grid:
        return cls(grid.height, grid.rows, grid.columns, SLACK)


class _Ellipses(ctypes.Structure):
    """``struct Ellipses`` of the kernels. It keeps none of the tensors alive."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in Ellipses._fields),
        ("count", ctypes.c_int64),
    )

    @classmethod
    def of(cls, ellipses: Ellipses) -> _Ellipses:
        return cls(*(tensor.data_ptr() for tensor in ellipses), len(ellipses.order))


class _Footprints(ctypes.Structure):
    """``struct Footprints`` of the kernels."""

    _fields_ = (
        ("grid", _Grid),
        ("ellipses", _Ellipses),
        *((name, ctypes.c_void_p) for name in ("means2d", "cov2d", "det", "opacities", "cameras")),
        ("alpha_min", ctypes.c_float),
        ("next", ctypes.c_void_p),
    )


class _Listing(ctypes.Structure):
    """``struct Listing`` of the kernels."""

    _fields_ = (
        ("grid", _Grid),
        ("ellipses", _Ellipses),
        *((name, ctypes.c_int64) for name in ("top", "bottom", "left", "right", "tiles")),
        *((name, ctypes.c_void_p) for name in ("starts", "strips", "counts", "offsets", "gaussians", "places", "next")),
    )


def can_list(wanted: bool | None, *tensors: Tensor) -> bool:
    """Whether the kernels find the tiles of Gaussians of which these are means, covariances and so on.

    Args:
        wanted: None where a machine without a compiler is no reason for a warning.
        tensors: floating point.
    """
    return KERNELS.usable_for(wanted, *tensors)


def ellipses_of(
    means2d: Tensor,
    cov2d: Tensor,
    det: Tensor,
    opacities: Tensor,
    order: Tensor,
    cameras: Tensor,
    grid: Grid,
    alpha_min: float,
) -> Ellipses:
    """As :func:`pointsplat_ns.rasterizer.ellipses.ellipses_of`."""
    given = [tensor.contiguous() for tensor in (means2d, cov2d, det, opacities, cameras)]
    numbers = [torch.empty_like(order) for _ in range(5)]
    found = Ellipses(order, numbers[0], means2d.new_empty(len(order), 7), *numbers[1:])
    next_range = torch.zeros(1, dtype=torch.int64)
    task = _Footprints(
        _Grid.of(grid), _Ellipses.of(found), *(tensor.data_ptr() for tensor in given), alpha_min,
        next_range.data_ptr(),
    )  # fmt: skip
    # Fewer are done sooner by one thread.
    on_threads(len(order) >= 4000, KERNELS.library.pointsplat_ellipses, ctypes.byref(task))
    return found


def pairs_of(ellipses: Ellipses, grid: Grid, region: Region) -> Pairs:
    """As :func:`pointsplat_ns.rasterizer.ellipses.pairs_of`."""
    library, count = KERNELS.library, len(ellipses.order)
    heights = ellipses.row1.clamp_max(region.bottom - 1).sub_(ellipses.row0.clamp_min(region.top)).add_(1).clamp_min_(0)
    starts = torch.zeros(count + 1, dtype=torch.int64)
    torch.cumsum(heights, 0, out=starts[1:])
    strips, counts = torch.empty(int(starts[-1]), 2, dtype=torch.int32), torch.zeros_like(ellipses.order)
    tiles = grid.cameras * region.rows * region.columns
    offsets, next_range = torch.zeros(tiles + 1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64)
    task = _Listing(
        _Grid.of(grid), _Ellipses.of(ellipses), *region, tiles, starts.data_ptr(), strips.data_ptr(),
        counts.data_ptr(), offsets.data_ptr(), next=next_range.data_ptr(),
    )  # fmt: skip
    on_threads(count >= 4000, library.pointsplat_strips, ctypes.byref(task))  # fewer are done sooner by one thread
    library.pointsplat_count(ctypes.byref(task))
    offsets = torch.cumsum(offsets, 0)
    gaussians, places = (offsets.new_empty(int(offsets[-1])) for _ in range(2))
    task.offsets, task.gaussians, task.places = offsets.data_ptr(), gaussians.data_ptr(), places.data_ptr()
    library.pointsplat_list(ctypes.byref(task))
    return Pairs(gaussians, offsets, places, counts)


def _as_torch() -> bool:
    """Whether the kernels find the pairs of some Gaussians in two images as torch does."""
    generator = torch.Generator().manual_seed(0)
    count, grid = 90, Grid(2, 43, 6, 8)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    means2d, cov2d = random(count, 2) * 70 - 5, torch.tensor([0.3, 0.0, 0.3]) + random(count, 3) * 9.0
    cov2d[:, 1] = (2 * random(count) - 1) * (cov2d[:, 0] * cov2d[:, 2]).sqrt()
    det, opacities = cov2d[:, 0] * cov2d[:, 2] - cov2d[:, 1] ** 2, random(count)
    order, cameras = torch.randperm(count, generator=generator), torch.arange(count) % 2
    found = []
    for functions in (in_torch.ellipses_of, in_torch.pairs_of), (ellipses_of, pairs_of):
        ellipses = functions[0](means2d, cov2d, det, opacities, order, cameras, grid, ALPHA_MIN)
        regions = [functions[1](ellipses, grid, region) for region in (Region(0, 6, 0, 8), Region(1, 4, 2, 7))]
        boxes = ellipses._replace(shapes=ellipses.shapes.round(decimals=2))  # the logarithm may round otherwise
        found.append([*boxes, *(tensor for pairs in regions for tensor in pairs)])
    return all(torch.equal(a, b) for a, b in zip(*found, strict=True))


KERNELS = Kernels(
    "the rasterizer",
    Path(__file__).with_name("tiles.cpp"),
    {f"pointsplat_{name}": [ctypes.c_void_p] for name in ("ellipses", "strips", "count", "list")},
    _as_torch,
)
