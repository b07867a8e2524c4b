"""Which Gaussian touches which tile, exactly, in drawing order.

A Gaussian is paired with a tile only if its own 1/255 ellipse meets the box of the tile's pixel
centres: for each row of tiles the ellipse's extent in x over that row is known in closed form, and
the tiles it covers are an interval.

An image is one region of tiles, or several where its pairs would not fit a budget of memory. A tile's
list does not depend on the region that it is part of.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import ALPHA_MIN, TILE

SLACK = 1e-3
"""Pixels added around each ellipse, so that rounding never drops a pixel that is drawn."""


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


@dataclass
class TileList:
    """For each tile of a region the Gaussians that touch it, front to back; P pairs in all."""

    gaussians: Tensor  # [P] int64, rows of the projected Gaussians, grouped by tile
    offsets: Tensor  # [cameras * rows * columns + 1] int64, where each tile's group starts
    places: Tensor  # [P] int64, where each pair stands when pairs are grouped by Gaussian (in depth order) instead
    counts: Tensor  # [M] int64, pairs of each Gaussian, in depth order
    order: Tensor  # [M] int64, the Gaussians in depth order
    region: Region

    def centres(self, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates (x, y) of the centres of tiles (B,) of the region, int64."""
        columns = self.region.columns
        within = tiles % (self.region.rows * columns)
        row = torch.div(within, columns, rounding_mode="floor")
        column = within - row * columns
        return (column + self.region.left) * TILE + TILE // 2, (row + self.region.top) * TILE + TILE // 2


def _by_depth(depths: Tensor) -> Tensor:
    """Rows in ascending order of depth, equal depths in the order of the input."""
    bits = depths.view(torch.int32 if depths.dtype == torch.float32 else torch.int64)
    # as integers floats keep their order, negative ones reversed; integers go through a radix sort
    bits = torch.where(bits < 0, bits ^ torch.iinfo(bits.dtype).max, bits)
    return torch.sort(bits, stable=True).indices


def _expand(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For ``counts`` (M,): the owner of each of ``sum(counts)`` items and its place with that owner."""
    owner = torch.repeat_interleave(counts)
    starts = torch.cumsum(counts, 0) - counts
    place = torch.arange(owner.numel(), device=counts.device)
    return owner, place.sub_(starts.index_select(0, owner))


class Footprints:
    """The 1/255 ellipses of projected Gaussians, in depth order."""

    @torch.no_grad()
    def __init__(
        self,
        means2d: Tensor,  # [M, 2] pixels
        cov2d: Tensor,  # [M, 3] xx, xy, yy
        det: Tensor,  # [M]
        opacities: Tensor,  # [M]
        depths: Tensor,  # [M] from any plane, which may be another for each camera
        camera_ids: Tensor,  # [M] int64
        cameras: int,
        width: int,
        height: int,
        alpha_min: float = ALPHA_MIN,
    ):
        self.cameras, self.width, self.height = cameras, width, height
        self.columns, self.rows = -(-width // TILE), -(-height // TILE)
        self.order = _by_depth(depths.contiguous())
        xx, xy, yy = cov2d.unbind(-1)
        level = 2.0 * (opacities / alpha_min).log().clamp_min_(0.0)
        # Over a strip of y, the right edge mx + r dy + sqrt(v (level - dy^2 / yy)) is concave in dy, with
        # its maximum at dy = xy sqrt(level / xx); the left edge mirrors it.
        peak, slope, variance = xy * (level / xx).sqrt(), xy / yy, det / yy
        shapes = torch.stack([*means2d.unbind(-1), level, 1.0 / yy, peak, slope, variance], dim=-1)
        self.shapes = shapes.index_select(0, self.order)  # [M, 7]
        self.camera_ids = camera_ids.index_select(0, self.order)
        mx, my = self.shapes[:, 0], self.shapes[:, 1]
        half_x, half_y = ((level * v).sqrt_().index_select(0, self.order).add_(SLACK) for v in (xx, yy))
        # the box around the ellipse, in tiles
        self.row0 = _tile_of(my - half_y, up=True, tiles=self.rows)
        self.row1 = _tile_of(my + half_y, up=False, tiles=self.rows)
        self.column0 = _tile_of(mx - half_x, up=True, tiles=self.columns)
        self.widths = (_tile_of(mx + half_x, up=False, tiles=self.columns) - self.column0 + 1).clamp_min_(0)

    @property
    def whole(self) -> Region:
        """All tiles of the image."""
        return Region(0, self.rows, 0, self.columns)

    def regions(self, most_pairs: int) -> list[Region]:
        """The image as few regions of at most about ``most_pairs`` pairs each, by a bound on their number.

        A tile is not divided: one that all M Gaussians touch makes M pairs.
        """
        if self.order.numel() * self.rows * self.columns <= most_pairs:
            return [self.whole]
        heights = (self.row1 - self.row0 + 1).clamp_min_(0)
        if int((heights * self.widths).sum()) <= most_pairs:  # boxes around the ellipses
            return [self.whole]
        widths = torch.where(heights > 0, self.widths, 0)
        regions = []
        for top, bottom, pairs in _intervals(_spread(self.row0, heights, widths, self.rows), most_pairs):
            if pairs <= most_pairs:
                regions.append(Region(top, bottom, 0, self.columns))
                continue
            reaching = (self.row0 <= top) & (self.row1 >= top)  # one row of tiles is too many
            columns = _spread(self.column0[reaching], self.widths[reaching], 1, self.columns)
            regions += [Region(top, bottom, left, right) for left, right, _ in _intervals(columns, most_pairs)]
        return regions

    def _strips(self, region: Region) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Each row of tiles that each Gaussian reaches: the Gaussian (depth order), the row, first and last column."""
        row0 = self.row0.clamp_min(region.top)
        row1 = self.row1.clamp_max(region.bottom - 1)
        owner, row = _expand((row1 - row0 + 1).clamp_min_(0))
        row += row0.index_select(0, owner)
        mx, my, level, inverse_yy, peak, slope, variance = self.shapes.index_select(0, owner).unbind(-1)
        top = row * TILE + (0.5 - SLACK) - my
        bottom = (row * TILE + (TILE - 0.5)).clamp_(max=self.height - 0.5) + SLACK - my

        def edge(dy: Tensor, sign: float) -> Tensor:
            dy = torch.minimum(torch.maximum(dy, top), bottom)
            reach = (level - dy * dy * inverse_yy).clamp_min_(0).mul_(variance).sqrt_().add_(SLACK)
            return (mx + slope * dy).add_(reach, alpha=sign)

        column0 = _tile_of(edge(-peak, -1.0), up=True, tiles=self.columns).clamp_(min=region.left)
        column1 = _tile_of(edge(peak, 1.0), up=False, tiles=self.columns).clamp_(max=region.right - 1)
        return owner, row, column0, column1

    @torch.no_grad()
    def tiles(self, region: Region) -> TileList:
        """Pair Gaussians with tiles and sort the pairs by tile, then depth, then row of the input."""
        rows, columns = region.rows, region.columns
        owner, row, column0, column1 = self._strips(region)
        widths = (column1 - column0 + 1).clamp_min_(0)
        counts = torch.zeros_like(self.order).index_add_(0, owner, widths)
        first = (self.camera_ids.index_select(0, owner) * rows + row - region.top) * columns + column0 - region.left
        strip, tile = _expand(widths)
        tile += first.index_select(0, strip)
        gaussian = self.order.index_select(0, owner).index_select(0, strip)

        tiles = self.cameras * rows * columns
        if tiles < 2**31:  # the fewer the bits, the fewer the passes of a radix sort
            tile = tile.to(torch.int16 if tiles < 2**15 else torch.int32)
        tile, places = torch.sort(tile, stable=True)
        edges = torch.arange(tiles + 1, device=tile.device, dtype=tile.dtype if tiles < 2**15 - 1 else torch.int64)
        offsets = torch.searchsorted(tile.to(edges.dtype), edges)
        return TileList(gaussian.index_select(0, places), offsets, places, counts, self.order, region)


def _spread(first: Tensor, lengths: Tensor, amounts: Tensor | int, bins: int) -> list[int]:
    """What each bin gets when each item gives its amount to ``lengths`` bins from ``first`` on."""
    amounts = torch.where(lengths > 0, amounts, 0)  # a negative length is none
    steps = torch.zeros(bins + 1, dtype=torch.int64, device=first.device)
    steps.index_add_(0, first.clamp(0, bins), amounts)
    steps.index_add_(0, (first + lengths).clamp(0, bins), -amounts)
    return torch.cumsum(steps, 0)[:-1].tolist()


def _intervals(amounts: list[int], most: int) -> list[tuple[int, int, int]]:
    """Consecutive bins put together as long as their sum is at most ``most``: first, end and sum."""
    intervals, first, total = [], 0, 0
    for i, amount in enumerate(amounts):
        if i > first and total + amount > most:
            intervals.append((first, i, total))
            first, total = i, 0
        total += amount
    return [*intervals, (first, len(amounts), total)]


def _tile_of(position: Tensor, up: bool, tiles: int) -> Tensor:
    """First tile with a pixel centre at or after ``position`` (up), or last with one at or before."""
    if up:
        tile = torch.ceil((position - (TILE - 0.5)) / TILE)
        return tile.clamp_(0, tiles).long()
    tile = torch.floor((position - 0.5) / TILE)
    return tile.clamp_(-1, tiles - 1).long()
