"""The exact set of tiles that each Gaussian touches, in drawing order.

A Gaussian is paired with a tile only if its 1/255 ellipse intersects the box of the tile's pixel
centres. Within each row of tiles, the ellipse's extent in x has a closed form, and the touched
tiles are an interval.
"""

from __future__ import annotations

import torch

from pointsplat_ns.rendering import ellipses as in_torch
from pointsplat_ns.rendering.compiled import tile_kernels as by_kernels
from pointsplat_ns.rendering.constants import ALPHA_MIN
from pointsplat_ns.rendering.ellipses import Grid, TileList
from pointsplat_ns.rendering.projection import Projected
from pointsplat_ns.system.kernels import KERNELS


class Footprints:
    """Ellipses within which projected Gaussians are drawn, in depth order, computed in torch
    (:mod:`~pointsplat_ns.rendering.ellipses`) or with compiled kernels.

    Args:
        seen: M Gaussians.
        width, height: of the image, pixels.
        alpha_min: a Gaussian with a lower alpha is not drawn.
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
        self.grid = Grid(width, height, alpha_min)
        shapes = seen.means2d, seen.cov2d, seen.det, seen.opacities
        self.compiled = KERNELS.usable_for(compiled, *shapes)
        self._engine = by_kernels if self.compiled else in_torch
        order = self._engine.by_depth(seen.depth_keys.contiguous())
        self._ellipses = self._engine.ellipses_of(*shapes, order, self.grid)

    def regions(self, most_pairs: int) -> list[tuple[int, int]]:
        """Split the image into as few bands of rows of tiles, first and one past the last, as
        possible, with at most about ``most_pairs`` pairs each, by an upper bound of their number. A
        row is not split."""
        rows = self.grid.rows
        columns = self.grid.columns
        boxes = self._ellipses.boxes
        if len(boxes) * rows * columns <= most_pairs:
            return [(0, rows)]
        row0, row1, column0, column1 = boxes.long().unbind(1)
        heights = (row1 - row0 + 1).clamp_min_(0)
        widths = (column1 - column0 + 1).clamp_min_(0)
        if int((heights * widths).sum()) <= most_pairs:  # bounding boxes of the ellipses
            return [(0, rows)]
        steps = torch.zeros(rows + 1, dtype=torch.int64, device=boxes.device)
        steps.index_add_(0, row0, widths).index_add_(0, row0 + heights, -widths)
        bands = []
        top = 0
        total = 0
        for row, pairs in enumerate(torch.cumsum(steps, 0)[:-1].tolist()):
            if row > top and total + pairs > most_pairs:
                bands.append((top, row))
                top = row
                total = 0
            total += pairs
        return [*bands, (top, rows)]

    @torch.no_grad()
    def tiles(self, top: int = 0, bottom: int | None = None) -> TileList:
        """Pair Gaussians with the tiles of the rows from ``top`` up to, but not including,
        ``bottom``, by default all rows; sorted by tile, then depth, then input row."""
        return self._engine.pairs_of(
            self._ellipses, self.grid, top, self.grid.rows if bottom is None else bottom
        )
