"""Blending in plain torch: tiles with lists of similar length, in blocks that fit the cache.

Chunks have sixteen Gaussians, more if few tiles are left; tiles whose pixels are all saturated are
dropped.

Shapes: P pairs, B tiles of a block, S Gaussians of a chunk, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.rendering.alpha import (
    STEP_BY_STEP,
    alphas_,
    is_clamped,
    is_drawn,
    last_transmittance,
    transmittances,
)
from pointsplat_ns.rendering.constants import ALPHA_MAX, TILE
from pointsplat_ns.rendering.ellipses import Grid, TileList
from pointsplat_ns.rendering.quadratics import (
    MOMENTS,
    PIXELS,
    Quadratics,
    basis_of,
    gather,
    mean_slopes,
    moments,
    table_of,
)
from pointsplat_ns.rendering.quadratics import chain as chain  # part of this module's interface


class Inputs(NamedTuple):
    """Projected Gaussians to blend."""

    table: Tensor  # [M + 1, 11 + D]
    channels: int
    may_clamp: bool  # some opacity exceeds ALPHA_MAX
    alpha_min: float
    basis: Tensor  # [6, 64]


def inputs_of(
    means2d: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor, colors: Tensor, alpha_min: float
) -> Inputs:
    """Blending inputs from projected Gaussians (M, ...) and their colours (M, D)."""
    table = table_of(means2d, cov2d, det, opacities, colors)
    return Inputs(
        table, colors.shape[1], bool((opacities > ALPHA_MAX).any()), alpha_min, basis_of(means2d)
    )


class WorkArrays:
    """Work arrays of a block, allocated once for a number of pairs and of tiles."""

    def __init__(self, pairs: int, tiles: int, like: Tensor):
        self._arrays = [like.new_empty(pairs * PIXELS) for _ in range(3)]
        self._through = like.new_empty((pairs + tiles) * PIXELS)

    def array(self, which: int, b: int, s: int) -> Tensor:
        """(B, S, 64)"""
        return self._arrays[which][: b * s * PIXELS].view(b, s, PIXELS)

    def through(self, b: int, s: int) -> Tensor:
        """(B, S + 1, 64)"""
        return self._through[: b * (s + 1) * PIXELS].view(b, s + 1, PIXELS)


def _sums_behind(terms: Tensor, behind: Tensor, out: Tensor) -> Tensor:
    """Suffix sums (B, S + 1, 64) of the terms (B, S, 64), plus ``behind`` (B, 64)."""
    out[:, -1] = behind
    if terms.shape[1] > STEP_BY_STEP:
        torch.add(terms.flip(1).cumsum(1).flip(1), behind[:, None], out=out[:, :-1])
        return out
    sums = out.unbind(1)
    for k, term in reversed(list(enumerate(terms.unbind(1)))):
        torch.add(sums[k + 1], term, out=sums[k])
    return out


def _pass_chunk(
    inputs: Inputs, pairs: Quadratics, before: Tensor, work: WorkArrays
) -> tuple[Tensor, Tensor, Tensor]:
    """Alpha and transmittance of a chunk, for both passes, in work arrays 0 and 1 and the array of
    transmittances.

    Returns:
        Alphas and 1 - alpha (B, S, 64), and transmittances that ignore that pixels are finished
        (B, S + 1, 64).
    """
    b, s = pairs.rows.shape[:2]
    alpha = work.array(0, b, s)
    torch.mm(pairs.coefficients, inputs.basis, out=alpha.view(-1, PIXELS))
    alpha = alphas_(alpha, inputs.alpha_min, inputs.may_clamp)
    passing = torch.sub(1.0, alpha, out=work.array(1, b, s))
    return alpha, passing, transmittances(passing, before, work.through(b, s))


def blend_chunk(
    inputs: Inputs,
    pairs: Quadratics,
    before: Tensor,
    last: Tensor,
    blended: Tensor,
    work: WorkArrays,
) -> tuple[Tensor, Tensor]:
    """Blend S Gaussians into each tile of ``blended`` (B, D, 64), in place.

    Returns:
        Transmittance after them, 0 if the pixel is finished, and the last one above the threshold,
        (B, 64) each.
    """
    alpha, passing, through = _pass_chunk(inputs, pairs, before, work)
    weight = alpha.mul_(through[:, :-1])
    after = through[:, -1].clone()
    if bool((~is_drawn(after) & (before > 0)).any()):  # this chunk finishes a pixel
        drawn = is_drawn(through[:, 1:], out=passing)
        weight.mul_(drawn)
        finished = last_transmittance(through, drawn)
        last = torch.where(finished > 0, finished, last)
        after.mul_(drawn[:, -1])
    else:
        last = torch.where(after > 0, after, last)
    blended.baddbmm_(pairs.colors.transpose(1, 2), weight)
    return after, last


def blend_chunk_backward(
    inputs: Inputs,
    pairs: Quadratics,
    before: Tensor,
    behind: Tensor,
    pixels: Tensor,
    work: WorkArrays,
) -> tuple[Tensor, Tensor, Tensor]:
    """The backward pass of one chunk.

    Args:
        behind: (B, 64) sum over later Gaussians of weight * (color . grad), and the background.
        pixels: (B, D, 64) gradient of the image.

    Returns:
        Gradients of log alpha (B, S, 64) and of the colours (B, D, S), and ``behind`` for the
        previous chunk.
    """
    b, s = pairs.rows.shape[:2]
    alpha, passing, through = _pass_chunk(inputs, pairs, before, work)
    weight = work.array(2, b, s)
    if not bool(is_drawn(through[:, -1]).all()):
        alpha.mul_(is_drawn(through[:, 1:], out=weight))
    torch.mul(alpha, through[:, :-1], out=weight)
    odds = torch.div(alpha, passing, out=passing)
    at_clamp = is_clamped(alpha) if inputs.may_clamp else None
    grad_colors = torch.bmm(pixels, weight.transpose(1, 2))
    weight.mul_(torch.bmm(pairs.colors, pixels, out=alpha))  # weight * (color . grad)
    # the transmittances are no longer needed
    sums_behind = _sums_behind(weight, behind, out=through)
    grad_log = weight.addcmul_(odds, sums_behind[:, 1:], value=-1.0)
    if at_clamp is not None:
        grad_log.masked_fill_(at_clamp, 0.0)
    return grad_log, grad_colors, sums_behind[:, 0].clone()


class Tiles(NamedTuple):
    """A selection of tiles, each field (B,)."""

    ids: Tensor  # int64, index in the region
    x: Tensor  # centre, pixels
    y: Tensor
    start: Tensor  # int64, first pair
    end: Tensor  # int64, one past the last pair

    def take(self, rows: Tensor) -> Tiles:
        return Tiles(*(values.index_select(0, rows) for values in self))


class Chunk(NamedTuple):
    """Tensors of one chunk of one block for the backward pass."""

    tiles: Tiles
    rows: Tensor | None  # [B] tiles of the block that are left; None if all are
    first: int  # position in each tile's list
    size: int  # S
    before: Tensor  # [B, 64] transmittance before the chunk; 0 if the pixel is finished


class Frame:
    """The tiles of one region, longest list first, and their pairs."""

    STEP = 16
    """Number of Gaussians blended per tile before saturated tiles are dropped; chunks are multiples
    of it."""
    LONGEST = 1024
    """Maximum number of Gaussians in a chunk."""

    def __init__(self, grid: Grid, tiles: TileList, dtype: torch.dtype):
        lengths = tiles.offsets[1:] - tiles.offsets[:-1]
        self.grid = grid
        self.tiles = lengths.numel()
        self.occupied = int((lengths > 0).sum())
        ids = torch.sort(lengths, descending=True, stable=True).indices[: self.occupied]
        row = torch.div(ids, grid.columns, rounding_mode="floor")
        x, y = (
            (place * TILE + TILE // 2).to(dtype)
            for place in (ids - row * grid.columns, row + tiles.top)
        )
        self.sorted = Tiles(ids, x, y, tiles.offsets[ids], tiles.offsets[ids + 1])
        self.pairs_count = tiles.gaussians.numel()
        # the last pair is padding
        self.gaussians = F.pad(tiles.gaussians, (0, 1), value=tiles.order.numel())
        # Pairs per work array: on a CPU 2 MB in float32. The size is independent of the number of
        # threads, because the rounding of sums depends on where lists are cut.
        pairs = 2**18 if lengths.is_cuda else 2**13
        self.block = max(1, min(pairs // self.STEP, self.occupied))  # tiles
        self.capacity = pairs

    def chunk_size(self, tiles: int, longest: int) -> int:
        """Chunk size: larger if few tiles are left, no larger than their lists."""
        size = min(self.capacity // max(tiles, 1), longest + self.STEP - 1, self.LONGEST)
        return max(size // self.STEP, 1) * self.STEP

    def inside(self, tiles: Tiles) -> Tensor:
        """1 for the pixels of tiles (B,) inside the image, (B, 64)."""
        axis = torch.arange(TILE, device=tiles.x.device, dtype=torch.int64) - (TILE // 2)
        columns = tiles.x[:, None] + axis < self.grid.width
        rows = tiles.y[:, None] + axis < self.grid.height
        return (rows[:, :, None] & columns[:, None, :]).view(-1, PIXELS).to(tiles.x.dtype)

    def pairs(self, tiles: Tiles, first: int, size: int) -> Tensor:
        """Positions in the pair list of S Gaussians for each tile, (B * S,); one past all pairs if
        a list has ended."""
        place = tiles.start[:, None] + torch.arange(
            first, first + size, device=tiles.start.device, dtype=torch.int64
        )
        return place.masked_fill_(place >= tiles.end[:, None], self.pairs_count).view(-1)


Tape = tuple[Frame, list[list[Chunk]]]
"""Results of the forward pass for the backward pass: the chunks of each block."""


def _blend_block(
    frame: Frame,
    inputs: Inputs,
    work: WorkArrays,
    image: Tensor,
    final: Tensor,
    keep_tape: bool,
    begin: int,
) -> list[Chunk]:
    """Blend the tiles from ``begin`` on into their rows of ``image`` (tiles, D, 64) and ``final``
    (tiles, 64)."""
    left = Tiles(*(values[begin : begin + frame.block] for values in frame.sorted))
    rows = None
    longest = int(left.end[0] - left.start[0])
    before = frame.inside(left)
    blended = image.new_zeros(before.shape[0], inputs.channels, PIXELS)
    last = torch.ones_like(before)
    chunks: list[Chunk] = []
    first = 0
    while True:
        b = before.shape[0]
        s = frame.chunk_size(b, longest - first)
        ids = frame.gaussians.index_select(0, frame.pairs(left, first, s))
        pairs = gather(inputs.table, ids, left.x, left.y)
        if keep_tape:
            chunks.append(Chunk(left, rows, first, s, before))
        before, last = blend_chunk(inputs, pairs, before, last, blended, work)
        first += s
        if first >= longest:
            break
        alive = (left.end - left.start > first) & (before.amax(-1) > 0)
        still = int(alive.sum())
        if still == 0:
            break
        if still <= 0.9 * b:
            done = (~alive).nonzero()[:, 0]
            alive = alive.nonzero()[:, 0]
            finished = left.ids.index_select(0, done)
            image.index_copy_(0, finished, blended.index_select(0, done))
            final.index_copy_(0, finished, last.index_select(0, done))
            left = left.take(alive)
            rows = alive if rows is None else rows.index_select(0, alive)
            before, blended, last = (
                values.index_select(0, alive) for values in (before, blended, last)
            )
            longest = int((left.end - left.start).max())
    image.index_copy_(0, left.ids, blended)
    final.index_copy_(0, left.ids, last)
    return chunks


def blend_region(
    grid: Grid, tiles: TileList, inputs: Inputs, image: Tensor, final: Tensor, keep_tape: bool
) -> Tape | None:
    """Blend the tiles of a region into ``image`` (tiles, D, 64) and ``final`` (tiles, 64); returns
    the tape if requested."""
    frame = Frame(grid, tiles, image.dtype)
    if frame.occupied < frame.tiles:
        image.zero_()
        final.fill_(1.0)
    work = WorkArrays(frame.capacity, frame.block, image)
    begins = range(0, frame.occupied, frame.block)
    chunks = [_blend_block(frame, inputs, work, image, final, keep_tape, begin) for begin in begins]
    return (frame, chunks) if keep_tape else None


def differentiate_region(
    grid: Grid,
    tiles: TileList,
    inputs: Inputs,
    tape: Tape,
    final: Tensor,  # [tiles, 64]
    grad_image: Tensor,  # [tiles, D, 64]
    grad_final: Tensor,  # [tiles, 64]
    absgrad: bool,
) -> Tensor:
    """Moments, colour gradients and absolute gradients of the Gaussians from one region, (M,
    MOMENTS + D [+ 2])."""
    frame, blocks = tape
    total = sum(chunk.before.shape[0] * chunk.size for chunks in blocks for chunk in chunks)
    # in tape order
    sums = grad_image.new_empty(total + 1, MOMENTS + inputs.channels + (2 if absgrad else 0))
    sums[-1] = 0.0
    place = frame.gaussians.new_empty(total)  # in the pair list
    work = WorkArrays(frame.capacity, frame.block, grad_image)
    channels = inputs.channels
    done = 0
    for chunks in blocks:
        whole = chunks[0].tiles.ids
        block_pixels = grad_image.index_select(0, whole)  # [B, D, 64]
        # sum over later Gaussians of weight * (color . grad), and the background
        behind = grad_final.index_select(0, whole) * final.index_select(0, whole)
        for left, rows, first, s, before in reversed(chunks):
            b = before.shape[0]
            here = slice(done, done + b * s)
            done += b * s
            place[here] = frame.pairs(left, first, s)
            pairs = gather(
                inputs.table, frame.gaussians.index_select(0, place[here]), left.x, left.y
            )
            pixels = block_pixels if rows is None else block_pixels.index_select(0, rows)
            behind_here = behind if rows is None else behind.index_select(0, rows)
            grad_log, grad_colors, behind_here = blend_chunk_backward(
                inputs, pairs, before, behind_here, pixels, work
            )
            if rows is None:
                behind = behind_here
            else:
                behind.index_copy_(0, rows, behind_here)

            packed = sums[here]
            packed[:, MOMENTS : MOMENTS + channels].view(b, s, channels).copy_(
                grad_colors.transpose(1, 2)
            )
            flat = grad_log.view(-1, PIXELS)
            if absgrad:
                for column, slope in enumerate(mean_slopes(pairs.coefficients)):
                    slope = torch.mm(
                        slope, inputs.basis[:3], out=work.array(0, b, s).view(-1, PIXELS)
                    )
                    packed[:, MOMENTS + channels + column] = slope.mul_(flat).abs_().sum(-1)
            moments(pairs, torch.mm(inputs.basis, flat.T), packed)

    # sum pairs by Gaussian; pairs behind a saturated tile have no sum
    by_place = place.new_full((frame.pairs_count + 1,), total)
    by_place.index_copy_(0, place, torch.arange(total, device=place.device, dtype=torch.int64))
    by_gaussian = torch.empty_like(tiles.places).index_copy_(0, tiles.places, by_place[:-1])
    in_depth_order = F.embedding_bag(
        by_gaussian, sums, torch.cumsum(tiles.counts, 0) - tiles.counts, mode="sum"
    )
    return torch.empty_like(in_depth_order).index_copy_(0, tiles.order, in_depth_order)
