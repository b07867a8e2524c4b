"""Front-to-back alpha blending over tiles, with its own backward pass.

Tiles of similar length are blended together in blocks that fit the cache, CHUNK Gaussians at a time
(more where few tiles are left); tiles whose every pixel is saturated are dropped in between. What is
evaluated per pixel, and how gradients are summed, stands in :mod:`~pointsplat_ns.rasterizer.quadratics`.

Shapes: P pairs, B tiles of a block, S Gaussians of a chunk, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.rasterizer.compiled import SMALLEST, Kernels, kernels
from pointsplat_ns.rasterizer.constants import ALPHA_MAX, CHUNK, EXACT, TILE, Quality
from pointsplat_ns.rasterizer.quadratics import (
    MOMENTS,
    PIXELS,
    Pairs,
    basis_of,
    chain,
    gather,
    mean_slopes,
    moments,
    table_of,
)
from pointsplat_ns.rasterizer.tiles import Footprints, Region

_BLOCK_PAIRS = 2**12  # pairs evaluated at once, for each thread of a CPU: 1 MB a work array in float32
_BLOCK_PAIRS_COMPILED = 2**11  # compiled kernels have no calls to save, and fit the cache better
_BLOCK_PAIRS_GPU = 2**18
_LONGEST_CHUNK = 1024
_STEP_BY_STEP = 64  # longer chunks are scanned in fewer, larger operations
_BYTES_PER_PAIR = 192  # lists, tape and gradient sums in float32: 75 MB for 0.30 M pairs, less what every image takes

MEMORY_BUDGET = 2**31
"""Bytes that the lists of pairs of one image may take before it is drawn in several regions."""


class BlendOptions(NamedTuple):
    """How to blend."""

    quality: Quality = EXACT
    compiled: bool = False
    """Use compiled kernels where the machine can make them (float32, CPU)."""
    memory_budget: int = MEMORY_BUDGET


class _Tiles(NamedTuple):
    """Some tiles, each (B,)."""

    ids: Tensor  # int64, which tile of the region
    x: Tensor  # centre, pixels
    y: Tensor
    start: Tensor  # int64, first pair
    end: Tensor  # int64, one past the last pair

    def take(self, rows: Tensor) -> _Tiles:
        return _Tiles(*(values.index_select(0, rows) for values in self))


class _Chunk(NamedTuple):
    """What the backward pass keeps of one chunk of one block."""

    tiles: _Tiles
    rows: Tensor | None  # [B] which tiles of the block are left; None while all are
    first: int  # place in each tile's list
    size: int  # S
    before: Tensor  # [B, 64] transmittance before the chunk; 0 where the pixel is finished


class _Frame:
    """The tiles of one region, longest list first, and their pairs."""

    def __init__(self, footprints: Footprints, region: Region, dtype: torch.dtype, compiled: bool):
        tiles = self.list = footprints.tiles(region)
        lengths = tiles.offsets[1:] - tiles.offsets[:-1]
        self.width, self.height, self.tiles = footprints.width, footprints.height, lengths.numel()
        self.occupied = int((lengths > 0).sum())
        ids = torch.sort(lengths, descending=True, stable=True).indices[: self.occupied]
        x, y = (centre.to(dtype) for centre in tiles.centres(ids))
        self.sorted = _Tiles(ids, x, y, tiles.offsets[ids], tiles.offsets[ids + 1])
        self.pairs_count = tiles.gaussians.numel()
        self.gaussians = F.pad(tiles.gaussians, (0, 1), value=tiles.order.numel())  # the last pair is padding
        pairs = _BLOCK_PAIRS_COMPILED if compiled else _BLOCK_PAIRS
        pairs = _BLOCK_PAIRS_GPU if lengths.is_cuda else pairs * torch.get_num_threads()
        self.block = max(1, min(pairs // CHUNK, self.occupied))  # tiles
        self.capacity = pairs

    def chunk_size(self, tiles: int, longest: int) -> int:
        """Gaussians to blend at once: more where few tiles are left, no more than their lists hold."""
        size = min(self.capacity // max(tiles, 1), longest + CHUNK - 1, _LONGEST_CHUNK)
        return max(size // CHUNK, 1) * CHUNK

    def inside(self, tiles: _Tiles) -> Tensor:
        """1 for the pixels of tiles (B,) that are in the image, (B, 64)."""
        axis = torch.arange(TILE, device=tiles.x.device) - (TILE // 2)
        columns = tiles.x[:, None] + axis < self.width
        rows = tiles.y[:, None] + axis < self.height
        return (rows[:, :, None] & columns[:, None, :]).view(-1, PIXELS).to(tiles.x.dtype)

    def pairs(self, tiles: _Tiles, first: int, size: int) -> Tensor:
        """Places in the pair list of S Gaussians for each tile, (B * S,); one past all pairs where a list has ended."""
        place = tiles.start[:, None] + torch.arange(first, first + size, device=tiles.start.device)
        return place.masked_fill_(place >= tiles.end[:, None], self.pairs_count).view(-1)


class _Work:
    """The work arrays of a block, allocated once."""

    def __init__(self, frame: _Frame, like: Tensor):
        self._arrays = [like.new_empty(frame.capacity * PIXELS) for _ in range(3)]
        self._through = like.new_empty((frame.capacity + frame.block) * PIXELS)

    def array(self, which: int, b: int, s: int) -> Tensor:
        """(B, S, 64)"""
        return self._arrays[which][: b * s * PIXELS].view(b, s, PIXELS)

    def through(self, b: int, s: int) -> Tensor:
        """(B, S + 1, 64)"""
        return self._through[: b * (s + 1) * PIXELS].view(b, s + 1, PIXELS)


class _Scene(NamedTuple):
    """What is blended."""

    table: Tensor  # [M + 1, 11 + D]
    channels: int
    clamp: bool  # some opacity exceeds ALPHA_MAX
    quality: Quality
    basis: Tensor  # [6, 64]
    fused: Kernels | None  # the compiled chunk kernels
    limits: tuple[Tensor, Tensor]  # the thresholds of ``quality``, as compiled kernels take them

    @classmethod
    def of(cls, means2d, cov2d, det, opacities, colors, options: BlendOptions) -> _Scene:
        channels, quality = colors.shape[1], options.quality
        fused = None
        if options.compiled and colors.dtype == torch.float32 and colors.device.type == "cpu":
            fused = kernels(channels)
        limits = (colors.new_tensor(quality.alpha_min), colors.new_tensor(quality.transmittance_min))
        table = table_of(means2d, cov2d, det, opacities, colors)
        return cls(table, channels, bool((opacities > ALPHA_MAX).any()), quality, basis_of(means2d), fused, limits)


def _alphas(coefficients: Tensor, scene: _Scene, out: Tensor) -> Tensor:
    """Alphas (B, S, 64) from coefficients (B * S, 6), written into ``out``."""
    flat = out.view(-1, PIXELS)
    torch.mm(coefficients, scene.basis, out=flat)
    flat.exp2_()
    if scene.clamp:
        flat.clamp_(max=ALPHA_MAX)
    F.threshold_(flat, scene.quality.alpha_min, 0.0)
    return out


def _transmittances(passing: Tensor, before: Tensor, out: Tensor) -> Tensor:
    """Transmittance before each Gaussian and after the last, (B, S + 1, 64), from 1 - alpha (B, S, 64)."""
    out[:, 0] = before
    if passing.shape[1] <= _STEP_BY_STEP:
        steps = out.unbind(1)
        for k, factor in enumerate(passing.unbind(1)):
            torch.mul(steps[k], factor, out=steps[k + 1])
        return out
    groups = out[:, 1:].unflatten(1, (-1, CHUNK))  # products of each group at once, then group by group
    steps, factors = groups.unbind(2), passing.unflatten(1, (-1, CHUNK)).unbind(2)
    steps[0].copy_(factors[0])
    for k in range(1, CHUNK):
        torch.mul(steps[k - 1], factors[k], out=steps[k])
    for group in groups.unbind(1):
        group.mul_(before[:, None])
        before = group[:, -1]
    return out


def _sums_behind(terms: Tensor, behind: Tensor, out: Tensor) -> Tensor:
    """``behind`` (B, 64) plus the sum of the terms from each Gaussian on, (B, S + 1, 64), from terms (B, S, 64)."""
    out[:, -1] = behind
    if terms.shape[1] > _STEP_BY_STEP:
        torch.add(terms.flip(1).cumsum(1).flip(1), behind[:, None], out=out[:, :-1])
        return out
    sums = out.unbind(1)
    for k, term in reversed(list(enumerate(terms.unbind(1)))):
        torch.add(sums[k + 1], term, out=sums[k])
    return out


def _blend_chunk(
    scene: _Scene, pairs: Pairs, before: Tensor, last: Tensor, blended: Tensor, work: _Work
) -> tuple[Tensor, Tensor]:
    """Blend S Gaussians into each tile of ``blended`` (B, D, 64), in place.

    Returns:
        Transmittance after them, 0 where the pixel is finished, and the last one that was not, (B, 64) each.
    """
    b, s = pairs.rows.shape[:2]
    stop_below = scene.quality.transmittance_min
    alpha = _alphas(pairs.coefficients, scene, work.array(0, b, s))
    passing = torch.sub(1.0, alpha, out=work.array(1, b, s))
    through = _transmittances(passing, before, work.through(b, s))
    weight = alpha.mul_(through[:, :-1])
    after = through[:, -1].clone()
    if bool(((after <= stop_below) & (before > 0)).any()):
        drawn = torch.gt(through[:, 1:], stop_below, out=passing)
        weight.mul_(drawn)
        stop = through.gather(1, drawn.sum(1, keepdim=True).long())[:, 0]
        last = torch.where(stop > 0, stop, last)
        after.mul_(drawn[:, -1])
    else:
        last = torch.where(after > 0, after, last)
    blended.baddbmm_(pairs.colors.transpose(1, 2), weight)
    return after, last


def _blend_chunk_backward(
    scene: _Scene, pairs: Pairs, before: Tensor, behind: Tensor, pixels: Tensor, work: _Work
) -> tuple[Tensor, Tensor, Tensor]:
    """The backward pass of one chunk.

    Args:
        behind: (B, 64) sum over later Gaussians of weight * (color . grad), and the background.
        pixels: (B, D, 64) gradient of the image.

    Returns:
        Gradients of log alpha (B, S, 64) and of the colours (B, D, S), and ``behind`` for the chunk before.
    """
    b, s = pairs.rows.shape[:2]
    stop_below = scene.quality.transmittance_min
    alpha = _alphas(pairs.coefficients, scene, work.array(0, b, s))
    passing = torch.sub(1.0, alpha, out=work.array(1, b, s))
    through = _transmittances(passing, before, work.through(b, s))
    weight = work.array(2, b, s)
    if bool((through[:, -1] <= stop_below).any()):
        alpha.mul_(torch.gt(through[:, 1:], stop_below, out=weight))
    torch.mul(alpha, through[:, :-1], out=weight)
    odds = torch.div(alpha, passing, out=passing)
    at_clamp = alpha >= ALPHA_MAX * (1 - 1e-6) if scene.clamp else None
    grad_colors = torch.bmm(pixels, weight.transpose(1, 2))
    weight.mul_(torch.bmm(pairs.colors, pixels, out=alpha))  # weight * (color . grad)
    sums_behind = _sums_behind(weight, behind, out=through)  # the transmittances are no longer needed
    grad_log = weight.addcmul_(odds, sums_behind[:, 1:], value=-1.0)
    if at_clamp is not None:
        grad_log.masked_fill_(at_clamp, 0.0)
    return grad_log, grad_colors, sums_behind[:, 0].clone()


def _blend_block(
    frame: _Frame, scene: _Scene, work: _Work, image: Tensor, final: Tensor, keep_tape: bool, begin: int
) -> list[_Chunk]:
    """Blend the tiles from ``begin`` on into their rows of ``image`` (tiles, D, 64) and ``final`` (tiles, 64)."""
    left = _Tiles(*(values[begin : begin + frame.block] for values in frame.sorted))
    rows = None
    longest = int(left.end[0] - left.start[0])
    before = frame.inside(left)
    blended = image.new_zeros(before.shape[0], scene.channels, PIXELS)
    last = torch.ones_like(before)
    chunks: list[_Chunk] = []
    first = 0
    while True:
        b = before.shape[0]
        fused = scene.fused if b >= SMALLEST else None
        s = CHUNK if fused else frame.chunk_size(b, longest - first)
        ids = frame.gaussians.index_select(0, frame.pairs(left, first, s))
        pairs = gather(scene.table, ids, left.x, left.y)
        if keep_tape:
            chunks.append(_Chunk(left, rows, first, s, before))
        if fused:
            before, blended, last = fused.forward(pairs.rows, scene.basis, before, blended, last, *scene.limits)
        else:
            before, last = _blend_chunk(scene, pairs, before, last, blended, work)
        first += s
        if first >= longest:
            break
        alive = (left.end - left.start > first) & (before.amax(-1) > 0)
        still = int(alive.sum())
        if still == 0:
            break
        if still <= 0.9 * b:
            done, alive = (~alive).nonzero()[:, 0], alive.nonzero()[:, 0]
            finished = left.ids.index_select(0, done)
            image.index_copy_(0, finished, blended.index_select(0, done))
            final.index_copy_(0, finished, last.index_select(0, done))
            left, rows = left.take(alive), alive if rows is None else rows.index_select(0, alive)
            before, blended, last = (values.index_select(0, alive) for values in (before, blended, last))
            longest = int((left.end - left.start).max())
    image.index_copy_(0, left.ids, blended)
    final.index_copy_(0, left.ids, last)
    return chunks


def _blend_region(frame: _Frame, scene: _Scene, image: Tensor, final: Tensor, keep_tape: bool) -> list[list[_Chunk]]:
    """Blend the tiles of one region, block by block."""
    work = _Work(frame, image)
    begins = range(0, frame.occupied, frame.block)
    return [_blend_block(frame, scene, work, image, final, keep_tape, begin) for begin in begins]


def _blend_block_backward(
    frame: _Frame,
    scene: _Scene,
    work: _Work,
    final: Tensor,  # [tiles, 64]
    grad_image: Tensor,  # [tiles, D, 64]
    grad_final: Tensor,  # [tiles, 64]
    chunks: list[_Chunk],
    place: Tensor,  # [pairs of the chunks] int64, written: places in the pair list
    sums: Tensor,  # [pairs of the chunks, MOMENTS + D (+ 2)], written
) -> None:
    """The gradient sums of the pairs of one block, the last chunk first."""
    channels = scene.channels
    whole = chunks[0].tiles.ids
    block_pixels = grad_image.index_select(0, whole)  # [B, D, 64]
    # what lies behind: sum over later Gaussians of weight * (color . grad), and the background
    behind = grad_final.index_select(0, whole) * final.index_select(0, whole)
    done = 0
    for tiles, rows, first, s, before in reversed(chunks):
        b = before.shape[0]
        pixels = block_pixels if rows is None else block_pixels.index_select(0, rows)
        here = slice(done, done + b * s)
        done += b * s
        place[here] = frame.pairs(tiles, first, s)
        pairs = gather(scene.table, frame.gaussians.index_select(0, place[here]), tiles.x, tiles.y)
        behind_here = behind if rows is None else behind.index_select(0, rows)
        if scene.fused and b >= SMALLEST:
            grad_log, weight, behind_here = scene.fused.backward(
                pairs.rows, scene.basis, before, behind_here, pixels, *scene.limits
            )
            grad_colors = torch.bmm(pixels, weight.transpose(1, 2))  # [B, D, S]
        else:
            grad_log, grad_colors, behind_here = _blend_chunk_backward(scene, pairs, before, behind_here, pixels, work)
        if rows is None:
            behind = behind_here
        else:
            behind.index_copy_(0, rows, behind_here)

        packed = sums[here]
        packed[:, MOMENTS : MOMENTS + channels].view(b, s, channels).copy_(grad_colors.transpose(1, 2))
        flat = grad_log.view(-1, PIXELS)
        if sums.shape[1] > MOMENTS + channels:  # absolute gradients of the means
            for column, slope in enumerate(mean_slopes(pairs.coefficients)):
                slope = torch.mm(slope, scene.basis[:3], out=work.array(0, b, s).view(-1, PIXELS))
                packed[:, MOMENTS + channels + column] = slope.mul_(flat).abs_().sum(-1)
        moments(pairs, torch.mm(scene.basis, flat.T), packed)


def _blend_region_backward(
    frame: _Frame,
    scene: _Scene,
    tape: list[list[_Chunk]],
    final: Tensor,  # [tiles, 64]
    grad_image: Tensor,  # [tiles, D, 64]
    grad_final: Tensor,  # [tiles, 64]
    absgrad: bool,
) -> Tensor:
    """Moments, colour gradients and absolute gradients of the Gaussians from one region, (M, MOMENTS + D [+ 2])."""
    sizes = [sum(chunk.before.shape[0] * chunk.size for chunk in chunks) for chunks in tape]
    total = sum(sizes)
    sums = grad_image.new_empty(total + 1, MOMENTS + scene.channels + (2 if absgrad else 0))  # in the tape's order
    sums[-1] = 0.0
    place = frame.gaussians.new_empty(total)  # in the pair list
    work = _Work(frame, grad_image)
    for block in zip(tape, place.split(sizes), sums[:-1].split(sizes), strict=True):
        _blend_block_backward(frame, scene, work, final, grad_image, grad_final, *block)

    # group the sums of pairs by Gaussian; pairs behind a saturated tile have no sum
    by_place = place.new_full((frame.pairs_count + 1,), total)
    by_place.index_copy_(0, place, torch.arange(total, device=place.device))
    by_gaussian = torch.empty_like(frame.list.places).index_copy_(0, frame.list.places, by_place[:-1])
    counts = frame.list.counts
    in_depth_order = F.embedding_bag(by_gaussian, sums, torch.cumsum(counts, 0) - counts, mode="sum")
    return torch.empty_like(in_depth_order).index_copy_(0, frame.list.order, in_depth_order)


class Blend(torch.autograd.Function):
    """Blend projected Gaussians into the tiles of one region; see :func:`blend`."""

    @staticmethod
    def forward(ctx, means2d, cov2d, det, opacities, colors, footprints, region, keep_lists, options, absgrad_of):
        """The lists are kept for the backward pass only if ``keep_lists``."""
        frame = _Frame(footprints, region, means2d.dtype, options.compiled)
        image = colors.new_empty(frame.tiles, colors.shape[1], PIXELS)
        final = colors.new_empty(frame.tiles, PIXELS)
        if frame.occupied < frame.tiles:
            image.zero_()
            final.fill_(1.0)
        needs_grad = any(ctx.needs_input_grad)
        scene = _Scene.of(means2d, cov2d, det, opacities, colors, options)
        tape = _blend_region(frame, scene, image, final, needs_grad and keep_lists)
        if needs_grad:
            ctx.save_for_backward(means2d, cov2d, det, opacities, colors, final)
            ctx.kept = (frame, tape) if keep_lists else None
            ctx.arguments = footprints, region, options, absgrad_of
        return image, final

    @staticmethod
    def backward(ctx, grad_image, grad_final):
        means2d, cov2d, det, opacities, colors, final = ctx.saved_tensors
        footprints, region, options, absgrad_of = ctx.arguments
        scene = _Scene.of(means2d, cov2d, det, opacities, colors, options)
        if ctx.kept:
            frame, tape = ctx.kept
        else:
            frame = _Frame(footprints, region, means2d.dtype, options.compiled)
            tape = _blend_region(frame, scene, torch.empty_like(grad_image), torch.empty_like(final), True)
        summed = _blend_region_backward(frame, scene, tape, final, grad_image, grad_final, absgrad_of is not None)
        first, last = MOMENTS, MOMENTS + scene.channels
        if absgrad_of is not None:
            absgrad_of(summed[:, last:])
        grads = chain(summed[:, :first], cov2d, det, opacities)
        return *grads, summed[:, first:last], None, None, None, None, None


def blend(
    means2d: Tensor,  # [M, 2] pixels
    cov2d: Tensor,  # [M, 3] xx, xy, yy, pixels^2
    det: Tensor,  # [M] determinant of cov2d
    opacities: Tensor,  # [M] in (0, 1]
    colors: Tensor,  # [M, D]
    footprints: Footprints,
    options: BlendOptions = BlendOptions(),  # noqa: B008 - immutable
    absgrad_of: Callable[[Tensor], None] | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians into images.

    Args:
        footprints: of the same Gaussians.
        options: an image whose lists of pairs would take more than ``options.memory_budget`` bytes
            is drawn in several regions, one after the other, and their lists are made again for the
            backward pass.
        absgrad_of: called in the backward pass with the sums over pixels of the absolute gradients
            of means2d, (M, 2).

    Returns:
        Colours (C, H, W, D) over black, and the remaining transmittance (C, H, W, 1).
    """
    cameras, width, height = footprints.cameras, footprints.width, footprints.height
    regions = footprints.regions(max(1, options.memory_budget // _BYTES_PER_PAIR))
    if absgrad_of is not None and len(regions) > 1:
        absgrad_of = _Summed(absgrad_of, len(regions))

    def untile(values: Tensor, region: Region) -> Tensor:
        rows, columns = region.rows, region.columns
        values = values.view(cameras, rows, columns, -1, TILE, TILE).permute(0, 1, 4, 2, 5, 3)
        return values.reshape(cameras, rows * TILE, columns * TILE, -1)

    def assemble(parts: list[Tensor]) -> Tensor:
        """Regions run through rows of tiles, or through the columns of one row."""
        bands, row = [], []
        for part, region in zip(parts, regions, strict=True):
            row.append(untile(part, region))
            if region.right == footprints.columns:
                bands.append(torch.cat(row, dim=2) if len(row) > 1 else row[0])
                row = []
        whole = torch.cat(bands, dim=1) if len(bands) > 1 else bands[0]
        return whole[:, :height, :width]

    images, finals = [], []
    for region in regions:
        image, final = Blend.apply(
            means2d, cov2d, det, opacities, colors, footprints, region, len(regions) == 1, options, absgrad_of
        )
        images.append(image)
        finals.append(final)
    return assemble(images), assemble(finals)


class _Summed:
    """Hands on the sum of what it is called with, at the last of so many calls."""

    def __init__(self, receiver: Callable[[Tensor], None], calls: int):
        self.receiver, self.left, self.total = receiver, calls, None

    def __call__(self, values: Tensor) -> None:
        self.total = values if self.total is None else self.total + values
        self.left -= 1
        if self.left == 0:
            self.receiver(self.total)
