"""Input of blending one region of an image: its tiles, the Gaussians of each tile, and their quadratics.

Shapes: B tiles of a block, S Gaussians of a chunk, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.rasterizer.constants import ALPHA_MAX, TILE, Quality
from pointsplat_ns.rasterizer.quadratics import PIXELS, basis_of, table_of
from pointsplat_ns.rasterizer.tiles import Footprints, TileList

MEMORY_BUDGET = 2**31
"""Bytes that the lists of pairs of one image may take before it is drawn in several regions."""


class BlendOptions(NamedTuple):
    """Options of blending."""

    quality: Quality = Quality()
    compiled: bool | None = None
    """Use compiled kernels (float32, CPU): None where there are some, True with a warning where there are none."""
    memory_budget: int = MEMORY_BUDGET


class Tiles(NamedTuple):
    """Some tiles, each (B,)."""

    ids: Tensor  # int64, which tile of the region
    x: Tensor  # centre, pixels
    y: Tensor
    start: Tensor  # int64, first pair
    end: Tensor  # int64, one past the last pair

    def take(self, rows: Tensor) -> Tiles:
        return Tiles(*(values.index_select(0, rows) for values in self))


class Chunk(NamedTuple):
    """Tensors of one chunk of one block that the backward pass needs."""

    tiles: Tiles
    rows: Tensor | None  # [B] which tiles of the block are left; None while all are
    first: int  # place in each tile's list
    size: int  # S
    before: Tensor  # [B, 64] transmittance before the chunk; 0 where the pixel is finished


class Frame:
    """The tiles of one region, longest list first, and their pairs."""

    STEP = 16
    """Gaussians blended at once for each tile, before the saturated tiles are dropped; chunks are multiples of it."""
    LONGEST = 1024
    """Largest number of Gaussians in a chunk."""

    def __init__(self, footprints: Footprints, tiles: TileList, dtype: torch.dtype):
        lengths = tiles.offsets[1:] - tiles.offsets[:-1]
        self.width, self.height, self.tiles = footprints.width, footprints.height, lengths.numel()
        self.occupied = int((lengths > 0).sum())
        ids = torch.sort(lengths, descending=True, stable=True).indices[: self.occupied]
        x, y = (centre.to(dtype) for centre in tiles.centres(ids))
        self.sorted = Tiles(ids, x, y, tiles.offsets[ids], tiles.offsets[ids + 1])
        self.pairs_count = tiles.gaussians.numel()
        self.gaussians = F.pad(tiles.gaussians, (0, 1), value=tiles.order.numel())  # the last pair is padding
        # Pairs in a work array: on a CPU 2 MB in float32. The size does not depend on the number of threads, because
        # sums are rounded by how lists are cut.
        pairs = 2**18 if lengths.is_cuda else 2**13
        self.block = max(1, min(pairs // self.STEP, self.occupied))  # tiles
        self.capacity = pairs

    def chunk_size(self, tiles: int, longest: int) -> int:
        """Gaussians to blend at once: more where few tiles are left, no more than their lists hold."""
        size = min(self.capacity // max(tiles, 1), longest + self.STEP - 1, self.LONGEST)
        return max(size // self.STEP, 1) * self.STEP

    def inside(self, tiles: Tiles) -> Tensor:
        """1 for the pixels of tiles (B,) that are in the image, (B, 64)."""
        axis = torch.arange(TILE, device=tiles.x.device, dtype=torch.int64) - (TILE // 2)
        columns = tiles.x[:, None] + axis < self.width
        rows = tiles.y[:, None] + axis < self.height
        return (rows[:, :, None] & columns[:, None, :]).view(-1, PIXELS).to(tiles.x.dtype)

    def pairs(self, tiles: Tiles, first: int, size: int) -> Tensor:
        """Places in the pair list of S Gaussians for each tile, (B * S,); one past all pairs where a list has ended."""
        place = tiles.start[:, None] + torch.arange(first, first + size, device=tiles.start.device, dtype=torch.int64)
        return place.masked_fill_(place >= tiles.end[:, None], self.pairs_count).view(-1)


class Inputs(NamedTuple):
    """Projected Gaussians to blend."""

    table: Tensor  # [M + 1, 11 + D]
    channels: int
    may_clamp: bool  # some opacity exceeds ALPHA_MAX
    quality: Quality
    basis: Tensor  # [6, 64]

    @classmethod
    def of(cls, means2d, cov2d, det, opacities, colors, quality: Quality) -> Inputs:
        table = table_of(means2d, cov2d, det, opacities, colors)
        return cls(table, colors.shape[1], bool((opacities > ALPHA_MAX).any()), quality, basis_of(means2d))
