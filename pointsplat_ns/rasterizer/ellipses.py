"""The 1/255 ellipses of projected Gaussians, and the tiles that each touches, in torch.

Shapes: M Gaussians, P pairs of Gaussian and tile.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import SLACK, TILE


class Region(NamedTuple):
    """A rectangle of tiles: rows ``top`` to ``bottom`` - 1, columns ``left`` to ``right`` - 1."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def rows(self) -> int:
        return self.bottom - self.top

    @property
    def columns(self) -> int:
        return self.right - self.left


class Grid(NamedTuple):
    """The tiles of the image that the ellipses are in."""

    height: int  # pixels
    rows: int  # of tiles
    columns: int


class Ellipses(NamedTuple):
    """Ellipses of the Gaussians in depth order, from which their tiles follow."""

    order: Tensor  # [M] int64, rows of the projected Gaussians
    shapes: Tensor  # [M, 7] x, y, level, 1 / yy, peak, slope, variance; pixels
    row0: Tensor  # [M] int64, the first row of tiles of the box around the ellipse
    row1: Tensor  # [M] int64, the last; before the first where there is none
    column0: Tensor  # [M] int64, the first column
    widths: Tensor  # [M] int64, number of columns


class TileList(NamedTuple):
    """For each tile of a region the Gaussians that touch it, front to back; P pairs in all."""

    gaussians: Tensor  # [P] int64, rows of the projected Gaussians, grouped by tile
    offsets: Tensor  # [rows * columns + 1] int64, where each tile's group starts
    places: Tensor  # [P] int64, where each pair stands when pairs are grouped by Gaussian (in depth order) instead
    counts: Tensor  # [M] int64, pairs of each Gaussian, in depth order
    order: Tensor  # [M] int64, the Gaussians in depth order
    region: Region

    def centres(self, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates (x, y) of the centres of tiles (B,) of the region, int64."""
        row = torch.div(tiles, self.region.columns, rounding_mode="floor")
        column = tiles - row * self.region.columns
        return (column + self.region.left) * TILE + TILE // 2, (row + self.region.top) * TILE + TILE // 2


def ellipses_of(
    means2d: Tensor,  # [M, 2] pixels
    cov2d: Tensor,  # [M, 3] xx, xy, yy
    det: Tensor,  # [M]
    opacities: Tensor,  # [M]
    order: Tensor,  # [M] int64, rows in depth order
    grid: Grid,
    alpha_min: float,
) -> Ellipses:
    """The ellipses within which Gaussians have an alpha of at least ``alpha_min``."""
    xx, xy, yy = cov2d.unbind(-1)
    level = 2.0 * (opacities / alpha_min).log().clamp_min_(0.0)
    # Over a strip of y, the right edge mx + r dy + sqrt(v (level - dy^2 / yy)) is concave in dy, with
    # its maximum at dy = xy sqrt(level / xx); the left edge mirrors it.
    peak, slope, variance = xy * (level / xx).sqrt(), xy / yy, det / yy
    shapes = torch.stack([*means2d.unbind(-1), level, 1.0 / yy, peak, slope, variance], dim=-1)
    shapes = shapes.index_select(0, order)
    mx, my = shapes[:, 0], shapes[:, 1]
    half_x, half_y = ((level * v).sqrt_().index_select(0, order).add_(SLACK) for v in (xx, yy))
    # the box around the ellipse, in tiles
    row0, row1 = _tile_of(my - half_y, up=True, tiles=grid.rows), _tile_of(my + half_y, up=False, tiles=grid.rows)
    column0 = _tile_of(mx - half_x, up=True, tiles=grid.columns)
    widths = (_tile_of(mx + half_x, up=False, tiles=grid.columns) - column0 + 1).clamp_min_(0)
    return Ellipses(order, shapes, row0, row1, column0, widths)


def pairs_of(ellipses: Ellipses, grid: Grid, region: Region) -> TileList:
    """Pair Gaussians with the tiles of a region, and sort the pairs by tile, then depth, then row of the input."""
    owner, row, column0, column1 = _strips(ellipses, grid, region)
    widths = (column1 - column0 + 1).clamp_min_(0)
    counts = torch.zeros_like(ellipses.order).index_add_(0, owner, widths)
    first = (row - region.top) * region.columns + column0 - region.left
    strip, tile = _expand(widths)
    tile += first.index_select(0, strip)
    gaussian = ellipses.order.index_select(0, owner).index_select(0, strip)

    tiles = region.rows * region.columns
    if tiles < 2**31:  # the fewer the bits, the fewer the passes of a radix sort
        tile = tile.to(torch.int16 if tiles < 2**15 else torch.int32)
    tile, places = torch.sort(tile, stable=True)
    edges = torch.arange(tiles + 1, device=tile.device, dtype=tile.dtype if tiles < 2**15 - 1 else torch.int64)
    offsets = torch.searchsorted(tile.to(edges.dtype), edges)
    return TileList(gaussian.index_select(0, places), offsets, places, counts, ellipses.order, region)


def _strips(ellipses: Ellipses, grid: Grid, region: Region) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Each row of tiles that each Gaussian reaches: the Gaussian (depth order), the row, first and last column."""
    row0 = ellipses.row0.clamp_min(region.top)
    row1 = ellipses.row1.clamp_max(region.bottom - 1)
    owner, row = _expand((row1 - row0 + 1).clamp_min_(0))
    row += row0.index_select(0, owner)
    mx, my, level, inverse_yy, peak, slope, variance = ellipses.shapes.index_select(0, owner).unbind(-1)
    first = row.to(my.dtype) * TILE
    top = first + (0.5 - SLACK) - my
    bottom = (first + (TILE - 0.5)).clamp_(max=grid.height - 0.5) + SLACK - my

    def edge(dy: Tensor, sign: float) -> Tensor:
        dy = torch.minimum(torch.maximum(dy, top), bottom)
        reach = (level - dy * dy * inverse_yy).clamp_min_(0).mul_(variance).sqrt_().add_(SLACK)
        return (mx + slope * dy).add_(reach, alpha=sign)

    column0 = _tile_of(edge(-peak, -1.0), up=True, tiles=grid.columns).clamp_(min=region.left)
    column1 = _tile_of(edge(peak, 1.0), up=False, tiles=grid.columns).clamp_(max=region.right - 1)
    return owner, row, column0, column1


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For ``counts`` (M,): the owner of each of ``sum(counts)`` items and its place with that owner."""
    owner = torch.repeat_interleave(counts)
    starts = torch.cumsum(counts, 0) - counts
    place = torch.arange(owner.numel(), device=counts.device, dtype=torch.int64)
    return owner, place.sub_(starts.index_select(0, owner))


def _tile_of(position: Tensor, up: bool, tiles: int) -> Tensor:
    """First tile with a pixel centre at or after ``position`` (up), or last with one at or before."""
    if up:
        tile = torch.ceil((position - (TILE - 0.5)) / TILE)
        return tile.clamp_(0, tiles).long()
    tile = torch.floor((position - 0.5) / TILE)
    return tile.clamp_(-1, tiles - 1).long()
