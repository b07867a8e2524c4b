"""The tiles that each Gaussian touches, by compiled kernels (``tiles.cpp``), as
:mod:`~pointsplat_ns.rasterizer.ellipses` finds them."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import SLACK
from pointsplat_ns.rasterizer.ellipses import Ellipses, Grid, Region, TileList
from pointsplat_ns.system.kernels import KERNELS, SEVERAL, Struct, on_threads
from pointsplat_ns.system.tensors import INDICES


def _grid(grid: Grid) -> Struct:
    return KERNELS.structs["Grid"](height=grid.height, rows=grid.rows, columns=grid.columns, slack=SLACK)


def _ellipses(ellipses: Ellipses) -> Struct:
    return KERNELS.structs["Ellipses"](**ellipses._asdict(), count=len(ellipses.order))


def ellipses_of(
    means2d: Tensor,
    cov2d: Tensor,
    det: Tensor,
    opacities: Tensor,
    order: Tensor,
    grid: Grid,
    alpha_min: float,
) -> Ellipses:
    """As :func:`pointsplat_ns.rasterizer.ellipses.ellipses_of`."""
    numbers = [torch.empty_like(order) for _ in range(4)]
    found = Ellipses(order, means2d.new_empty(len(order), 7), *numbers)
    task = KERNELS.structs["Footprints"](
        grid=_grid(grid), ellipses=_ellipses(found), means2d=means2d.contiguous(), cov2d=cov2d.contiguous(),
        det=det.contiguous(), opacities=opacities.contiguous(), alpha_min=alpha_min,
    )  # fmt: skip
    on_threads(len(order) >= SEVERAL, KERNELS.library.pointsplat_ellipses, task)
    return found


def pairs_of(ellipses: Ellipses, grid: Grid, region: Region) -> TileList:
    """As :func:`pointsplat_ns.rasterizer.ellipses.pairs_of`."""
    library, count = KERNELS.library, len(ellipses.order)
    heights = ellipses.row1.clamp_max(region.bottom - 1).sub_(ellipses.row0.clamp_min(region.top)).add_(1).clamp_min_(0)
    starts = torch.zeros(count + 1, **INDICES)
    torch.cumsum(heights, 0, out=starts[1:])
    strips, counts = torch.empty(int(starts[-1]), 2, dtype=torch.int32, device="cpu"), torch.zeros_like(ellipses.order)
    tiles = region.rows * region.columns
    offsets = torch.zeros(tiles + 1, **INDICES)
    task = KERNELS.structs["Listing"](
        grid=_grid(grid), ellipses=_ellipses(ellipses), **region._asdict(), tiles=tiles, starts=starts, strips=strips,
        counts=counts, offsets=offsets,
    )  # fmt: skip
    on_threads(count >= SEVERAL, library.pointsplat_strips, task)
    library.pointsplat_count(task)
    offsets = torch.cumsum(offsets, 0)
    gaussians, places = (offsets.new_empty(int(offsets[-1])) for _ in range(2))
    task.fill(offsets=offsets, gaussians=gaussians, places=places)
    library.pointsplat_list(task)
    return TileList(gaussians, offsets, places, counts, ellipses.order, region)
