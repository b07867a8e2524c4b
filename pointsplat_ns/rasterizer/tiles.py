"""The tiles that each Gaussian touches, exactly, in drawing order.

A Gaussian is paired with a tile only if its own 1/255 ellipse meets the box of the tile's pixel
centres: for each row of tiles the ellipse's extent in x over that row is known in closed form, and
the tiles it covers are an interval.

An image is one region of tiles, or several where its pairs would not fit a budget of memory. A tile's
list does not depend on the region that it is part of.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.rasterizer import ellipses as in_torch
from pointsplat_ns.rasterizer.compiled import tiles as by_kernels
from pointsplat_ns.rasterizer.constants import ALPHA_MIN, TILE
from pointsplat_ns.rasterizer.ellipses import Grid
from pointsplat_ns.rasterizer.ellipses import Region as Region  # part of this module's interface, as the next
from pointsplat_ns.rasterizer.ellipses import TileList as TileList
from pointsplat_ns.rasterizer.projection import Projected
from pointsplat_ns.system.kernels import KERNELS


def _by_depth(depths: Tensor) -> Tensor:
    """Rows in ascending order of depth, equal depths in the order of the input."""
    bits = depths.view(torch.int32 if depths.dtype == torch.float32 else torch.int64)
    # integers, which are radix-sorted, with the order of the floats; bits of negative floats are in reverse order
    bits = torch.where(bits < 0, bits ^ torch.iinfo(bits.dtype).max, bits)
    return torch.sort(bits, stable=True).indices


class Footprints:
    """The ellipses of projected Gaussians within which they are drawn, in depth order, found in torch
    (:mod:`~pointsplat_ns.rasterizer.ellipses`) or by compiled kernels.

    Args:
        seen: M Gaussians.
        width, height: of the image, pixels.
        alpha_min: a Gaussian is not drawn where its alpha is lower.
        compiled: as for :func:`~pointsplat_ns.rasterization`.
    """

    @torch.no_grad()
    def __init__(
        self,
        seen: Projected,
        width: int,
        height: int,
        alpha_min: float = ALPHA_MIN,
        compiled: bool | None = None,
    ):
        self.width, self.height, self.alpha_min = width, height, alpha_min
        self.rows, self.columns = -(-height // TILE), -(-width // TILE)  # of tiles
        self._grid = Grid(height, self.rows, self.columns)
        shapes = seen.means2d, seen.cov2d, seen.det, seen.opacities
        self._engine = by_kernels if KERNELS.usable_for(compiled, *shapes) else in_torch
        order = _by_depth(seen.depth_keys.contiguous())
        self._ellipses = self._engine.ellipses_of(*shapes, order, self._grid, alpha_min)

    @property
    def whole(self) -> Region:
        """All tiles of the image."""
        return Region(0, self.rows, 0, self.columns)

    def regions(self, most_pairs: int) -> list[Region]:
        """The image as few regions of at most about ``most_pairs`` pairs each, by a bound on their number.

        A tile is not divided: one that all M Gaussians touch makes M pairs.
        """
        row0, column0, widths = self._ellipses.row0, self._ellipses.column0, self._ellipses.widths
        if row0.numel() * self.rows * self.columns <= most_pairs:
            return [self.whole]
        heights = (self._ellipses.row1 - row0 + 1).clamp_min_(0)
        if int((heights * widths).sum()) <= most_pairs:  # boxes around the ellipses
            return [self.whole]
        widths = torch.where(heights > 0, widths, 0)
        regions = []
        for top, bottom, pairs in _intervals(_spread(row0, heights, widths, self.rows), most_pairs):
            if pairs <= most_pairs:
                regions.append(Region(top, bottom, 0, self.columns))
                continue
            reaching = (row0 <= top) & (self._ellipses.row1 >= top)  # one row of tiles is too many
            columns = _spread(column0[reaching], widths[reaching], 1, self.columns)
            regions += [Region(top, bottom, left, right) for left, right, _ in _intervals(columns, most_pairs)]
        return regions

    @torch.no_grad()
    def tiles(self, region: Region) -> TileList:
        """Pair Gaussians with tiles and sort the pairs by tile, then depth, then row of the input."""
        return self._engine.pairs_of(self._ellipses, self._grid, region)


def _spread(first: Tensor, lengths: Tensor, amounts: Tensor | int, bins: int) -> list[int]:
    """Sum of each bin, where each item adds its amount to ``lengths`` bins from ``first`` on."""
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
