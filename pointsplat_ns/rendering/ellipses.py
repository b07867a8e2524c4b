"""The 1/255 ellipses of projected Gaussians, and the tiles that they touch, in torch.

Shapes: M Gaussians, P pairs of Gaussian and tile.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rendering.constants import SLACK, TILE


class Grid(NamedTuple):
    """Tile grid of the image."""

    width: int  # pixels
    height: int
    alpha_min: float  # a Gaussian with a lower alpha is not drawn

    @property
    def rows(self) -> int:
        return -(-self.height // TILE)

    @property
    def columns(self) -> int:
        return -(-self.width // TILE)


class Ellipses(NamedTuple):
    """Ellipses within which Gaussians have an alpha of at least ``alpha_min``."""

    order: Tensor  # [M] int64, rows of the projected Gaussians in depth order
    # [M, 7] x, y, level, 1 / yy, peak, slope, variance, pixels, in depth order; or the kernels'
    # table
    shapes: Tensor
    # [M, 4] in the order of shapes: first and last row of tiles, first and last column
    boxes: Tensor


class TileList(NamedTuple):
    """Gaussians that touch each tile of some rows of tiles, front to back; P pairs in all."""

    gaussians: Tensor  # [P] int64, rows of the projected Gaussians, grouped by tile
    offsets: Tensor  # [tiles + 1] int64, start of each tile's group
    # [P] int64, position of each pair if grouped by Gaussian (in depth order) instead
    places: Tensor
    counts: Tensor  # [M] int64, pairs of each Gaussian, in depth order
    order: Tensor  # [M] int64, the Gaussians in depth order
    top: int  # first row of tiles


def by_depth(depths: Tensor) -> Tensor:
    """Rows in ascending order of depth; equal depths keep the input order."""
    bits = depths.view(torch.int32 if depths.dtype == torch.float32 else torch.int64)
    # integers, which are radix-sorted, in the order of the floats; the bits of negative floats are
    # in reverse order
    bits = torch.where(bits < 0, bits ^ torch.iinfo(bits.dtype).max, bits)
    return torch.sort(bits, stable=True).indices


def ellipses_of(
    means2d: Tensor,  # [M, 2] pixels
    cov2d: Tensor,  # [M, 3] xx, xy, yy
    det: Tensor,  # [M]
    opacities: Tensor,  # [M]
    order: Tensor,  # [M] int64, rows in depth order
    grid: Grid,
) -> Ellipses:
    """Ellipses of projected Gaussians."""
    xx, xy, yy = cov2d.unbind(-1)
    level = 2.0 * (opacities / grid.alpha_min).log().clamp_min_(0.0)
    # Over a strip of y, the right edge mx + r dy + sqrt(v (level - dy^2 / yy)) is concave in dy,
    # with its maximum at dy = xy sqrt(level / xx); the left edge mirrors it.
    peak = xy * (level / xx).sqrt()
    slope = xy / yy
    variance = det / yy
    shapes = torch.stack([*means2d.unbind(-1), level, 1.0 / yy, peak, slope, variance], dim=-1)
    shapes = shapes.index_select(0, order)
    mx = shapes[:, 0]
    my = shapes[:, 1]
    half_x, half_y = ((level * v).sqrt_().index_select(0, order).add_(SLACK) for v in (xx, yy))
    ends = ((my, half_y, grid.rows), (mx, half_x, grid.columns))
    boxes = [
        _tile_of(middle + sign * half, up=sign < 0, tiles=tiles)
        for middle, half, tiles in ends
        for sign in (-1, 1)
    ]
    return Ellipses(order, shapes, torch.stack(boxes, dim=1))


def pairs_of(ellipses: Ellipses, grid: Grid, top: int, bottom: int) -> TileList:
    """Pair Gaussians with the tiles of the rows from ``top`` up to, but not including, ``bottom``;
    sorted by tile, then depth, then input row."""
    owner, row, column0, column1 = _strips(ellipses, grid, top, bottom)
    widths = (column1 - column0 + 1).clamp_min_(0)
    counts = torch.zeros_like(ellipses.order).index_add_(0, owner, widths)
    first = (row - top) * grid.columns + column0
    strip, tile = _expand(widths)
    tile += first.index_select(0, strip)
    gaussian = ellipses.order.index_select(0, owner).index_select(0, strip)

    tiles = (bottom - top) * grid.columns
    if tiles < 2**31:  # fewer bits, fewer passes of the radix sort
        tile = tile.to(torch.int16 if tiles < 2**15 else torch.int32)
    tile, places = torch.sort(tile, stable=True)
    edges = torch.arange(
        tiles + 1, device=tile.device, dtype=tile.dtype if tiles < 2**15 - 1 else torch.int64
    )
    offsets = torch.searchsorted(tile.to(edges.dtype), edges)
    return TileList(gaussian.index_select(0, places), offsets, places, counts, ellipses.order, top)


def _strips(
    ellipses: Ellipses, grid: Grid, top_row: int, bottom_row: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Strips of tiles that Gaussians touch: Gaussian (depth order), row, first and last column."""
    row0 = ellipses.boxes[:, 0].clamp_min(top_row)
    row1 = ellipses.boxes[:, 1].clamp_max(bottom_row - 1)
    owner, row = _expand((row1 - row0 + 1).clamp_min_(0))
    row += row0.index_select(0, owner)
    mx, my, level, inverse_yy, peak, slope, variance = ellipses.shapes.index_select(
        0, owner
    ).unbind(-1)
    first = row.to(my.dtype) * TILE
    top = first + (0.5 - SLACK) - my
    bottom = (first + (TILE - 0.5)).clamp_(max=grid.height - 0.5) + SLACK - my

    def edge(dy: Tensor, sign: float) -> Tensor:
        dy = torch.minimum(torch.maximum(dy, top), bottom)
        reach = (level - dy * dy * inverse_yy).clamp_min_(0).mul_(variance).sqrt_().add_(SLACK)
        return (mx + slope * dy).add_(reach, alpha=sign)

    column0 = _tile_of(edge(-peak, -1.0), up=True, tiles=grid.columns)
    return owner, row, column0, _tile_of(edge(peak, 1.0), up=False, tiles=grid.columns)


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For ``counts`` (M,): the owner of each of ``sum(counts)`` items, and its position there."""
    owner = torch.repeat_interleave(counts)
    starts = torch.cumsum(counts, 0) - counts
    place = torch.arange(owner.numel(), device=counts.device, dtype=torch.int64)
    return owner, place.sub_(starts.index_select(0, owner))


def _tile_of(position: Tensor, up: bool, tiles: int) -> Tensor:
    """First tile with a pixel centre at or after ``position`` (up), or last one with a pixel centre
    at or before it."""
    if up:
        tile = torch.ceil((position - (TILE - 0.5)) / TILE)
        return tile.clamp_(0, tiles).long()
    tile = torch.floor((position - 0.5) / TILE)
    return tile.clamp_(-1, tiles - 1).long()
