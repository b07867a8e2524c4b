"""Which Gaussian touches which tile, exactly, in drawing order.

A Gaussian is paired with a tile only if its own 1/255 ellipse meets the box of the tile's pixel
centres: for each row of tiles the ellipse's extent in x over that row is known in closed form, and
the tiles it covers are an interval.

An image is one region of tiles, or several where its pairs would not fit a budget of memory. A tile's
list does not depend on the region it is made in.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import ALPHA_MIN, TILE

_SLACK = 1e-3  # pixels added around each ellipse, so that rounding never drops a pixel that is drawn


class Region(NamedTuple):
    """A rectangle of tiles: rows ``top`` to ``bottom`` - 1, columns ``left`` to ``right`` - 1."""

    top: int
    bottom: int
    left: int
    right: int


@dataclass
class TileList:
    """For each tile of a region the Gaussians that touch it, front to back; P pairs in all."""

    gaussians: Tensor  # [P] int64, rows of the projected Gaussians, grouped by tile
    offsets: Tensor  # [cameras * rows * columns + 1] int64, where each tile's group starts
    places: Tensor  # [P] int64, where each pair stands when pairs are grouped by Gaussian (in depth order) instead
    counts: Tensor  # [M] int64, pairs of each Gaussian, in depth order
    order: Tensor  # [M] int64, the Gaussians in depth order
    region: Region

    @property
    def rows(self) -> int:
        return self.region.bottom - self.region.top

    @property
    def columns(self) -> int:
        return self.region.right - self.region.left

    def centres(self, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates (x, y) of the centres of tiles (B,) of the region, int64."""
        within = tiles % (self.rows * self.columns)
        row = torch.div(within, self.columns, rounding_mode="floor")
        column = within - row * self.columns
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
        depths: Tensor,  # [M]
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
        my = self.shapes[:, 1]
        half_y = (level * yy).sqrt_().index_select(0, self.order).add_(_SLACK)
        self.row0 = _tile_of(my - half_y, up=True, tiles=self.rows)
        self.row1 = _tile_of(my + half_y, up=False, tiles=self.rows)

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
        # one row of tiles has at most `columns` pairs for each Gaussian that reaches it
        reached = torch.zeros(self.rows + 1, dtype=torch.int64, device=self.row0.device)
        touching = self.row1 >= self.row0
        ones = touching.long()
        reached.index_add_(0, self.row0.clamp_max(self.rows), ones)
        reached.index_add_(0, (self.row1 + 1).clamp(0, self.rows), -ones)
        bound = [count * self.columns for count in torch.cumsum(reached, 0)[:-1].tolist()]
        if sum(bound) > most_pairs:
            bound = self._row_pairs().tolist()
        regions, top, total = [], 0, 0
        for row, pairs in enumerate(bound):
            if total + pairs > most_pairs and row > top:
                regions.append(Region(top, row, 0, self.columns))
                top, total = row, 0
            total += pairs
            if pairs > most_pairs:  # even one row is too many
                parts = min(-(-pairs // most_pairs), self.columns)
                edges = [self.columns * part // parts for part in range(parts + 1)]
                regions += [Region(row, row + 1, a, b) for a, b in zip(edges, edges[1:], strict=False)]
                top, total = row + 1, 0
        if top < self.rows:
            regions.append(Region(top, self.rows, 0, self.columns))
        return regions

    def _row_pairs(self) -> Tensor:
        """Pairs of each row of tiles, (rows,) int64: exact, from one row at a time."""
        counts = []
        for row in range(self.rows):
            _, column0, column1 = self._strips(Region(row, row + 1, 0, self.columns))[1:4]
            counts.append((column1 - column0 + 1).clamp_min_(0).sum())
        return torch.stack(counts)

    def _strips(self, region: Region) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Each row of tiles that each Gaussian reaches: the Gaussian (depth order), the row, first and last column."""
        row0 = self.row0.clamp_min(region.top)
        row1 = self.row1.clamp_max(region.bottom - 1)
        owner, row = _expand((row1 - row0 + 1).clamp_min_(0))
        row += row0.index_select(0, owner)
        mx, my, level, inverse_yy, peak, slope, variance = self.shapes.index_select(0, owner).unbind(-1)
        top = row * TILE + (0.5 - _SLACK) - my
        bottom = (row * TILE + (TILE - 0.5)).clamp_(max=self.height - 0.5) + _SLACK - my

        def edge(dy: Tensor, sign: float) -> Tensor:
            dy = torch.minimum(torch.maximum(dy, top), bottom)
            reach = (level - dy * dy * inverse_yy).clamp_min_(0).mul_(variance).sqrt_().add_(_SLACK)
            return (mx + slope * dy).add_(reach, alpha=sign)

        column0 = _tile_of(edge(-peak, -1.0), up=True, tiles=self.columns).clamp_(min=region.left)
        column1 = _tile_of(edge(peak, 1.0), up=False, tiles=self.columns).clamp_(max=region.right - 1)
        return owner, row, column0, column1

    @torch.no_grad()
    def tiles(self, region: Region) -> TileList:
        """Pair Gaussians with tiles and sort the pairs by tile, then depth, then row of the input."""
        rows, columns = region.bottom - region.top, region.right - region.left
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


def intersect_tiles(
    means2d: Tensor,  # [M, 2] pixels
    cov2d: Tensor,  # [M, 3] xx, xy, yy
    det: Tensor,  # [M]
    opacities: Tensor,  # [M]
    depths: Tensor,  # [M]
    camera_ids: Tensor,  # [M] int64
    cameras: int,
    width: int,
    height: int,
) -> TileList:
    """The tile list of whole images; see :class:`Footprints`."""
    footprints = Footprints(means2d, cov2d, det, opacities, depths, camera_ids, cameras, width, height)
    return footprints.tiles(footprints.whole)


def _tile_of(position: Tensor, up: bool, tiles: int) -> Tensor:
    """First tile with a pixel centre at or after ``position`` (up), or last with one at or before."""
    if up:
        tile = torch.ceil((position - (TILE - 0.5)) / TILE)
        return tile.clamp_(0, tiles).long()
    tile = torch.floor((position - 0.5) / TILE)
    return tile.clamp_(-1, tiles - 1).long()
