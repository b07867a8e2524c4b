"""Front-to-back alpha blending over tiles, with its own backward pass.

Tiles of similar length are blended together in blocks that fit the cache, CHUNK Gaussians at a time
(more where few tiles are left); tiles whose every pixel is saturated are dropped in between. What is
evaluated per pixel, and how gradients are summed, stands in :mod:`~pointsplat_ns.rasterizer.quadratics`; which
Gaussian is drawn on which pixel in :mod:`~pointsplat_ns.rasterizer.alpha`.

Shapes: P pairs, B tiles of a block, S Gaussians of a chunk, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.rasterizer import eager
from pointsplat_ns.rasterizer.compiled import SMALLEST
from pointsplat_ns.rasterizer.constants import CHUNK, TILE
from pointsplat_ns.rasterizer.frame import BlendOptions, Chunk, Frame, Inputs, Tiles
from pointsplat_ns.rasterizer.precision import full_precision
from pointsplat_ns.rasterizer.quadratics import MOMENTS, PIXELS, chain, gather, mean_slopes, moments
from pointsplat_ns.rasterizer.tiles import Footprints, Region

_BYTES_PER_PAIR = 192  # of RGB in float32: lists, tape, gradient sums; 75 MB for 0.30 M pairs, less what images take


def bytes_per_pair(colors: Tensor) -> int:
    """Bytes that a pair of tile and Gaussian takes with colours (M, D): each channel has a gradient sum."""
    size = colors.element_size()
    return _BYTES_PER_PAIR * size // 4 + (colors.shape[1] - 3) * size


def _blend_block(
    frame: Frame, inputs: Inputs, work: eager.WorkArrays, image: Tensor, final: Tensor, keep_tape: bool, begin: int
) -> list[Chunk]:
    """Blend the tiles from ``begin`` on into their rows of ``image`` (tiles, D, 64) and ``final`` (tiles, 64)."""
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
        fused = inputs.fused if b >= SMALLEST else None
        s = CHUNK if fused else frame.chunk_size(b, longest - first)
        ids = frame.gaussians.index_select(0, frame.pairs(left, first, s))
        pairs = gather(inputs.table, ids, left.x, left.y)
        if keep_tape:
            chunks.append(Chunk(left, rows, first, s, before))
        if fused:
            before, blended, last = fused.forward(pairs.rows, inputs.basis, before, blended, last, *inputs.limits)
        else:
            before, last = eager.blend_chunk(inputs, pairs, before, last, blended, work)
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


def _blend_region(frame: Frame, inputs: Inputs, image: Tensor, final: Tensor, keep_tape: bool) -> list[list[Chunk]]:
    """Blend the tiles of one region, block by block."""
    work = eager.WorkArrays(frame, image)
    begins = range(0, frame.occupied, frame.block)
    return [_blend_block(frame, inputs, work, image, final, keep_tape, begin) for begin in begins]


def _blend_block_backward(
    frame: Frame,
    inputs: Inputs,
    work: eager.WorkArrays,
    final: Tensor,  # [tiles, 64]
    grad_image: Tensor,  # [tiles, D, 64]
    grad_final: Tensor,  # [tiles, 64]
    chunks: list[Chunk],
    place: Tensor,  # [pairs of the chunks] int64, written: places in the pair list
    sums: Tensor,  # [pairs of the chunks, MOMENTS + D (+ 2)], written
) -> None:
    """The gradient sums of the pairs of one block, the last chunk first."""
    channels = inputs.channels
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
        pairs = gather(inputs.table, frame.gaussians.index_select(0, place[here]), tiles.x, tiles.y)
        behind_here = behind if rows is None else behind.index_select(0, rows)
        if inputs.fused and b >= SMALLEST:
            grad_log, weight, behind_here = inputs.fused.backward(
                pairs.rows, inputs.basis, before, behind_here, pixels, *inputs.limits
            )
            grad_colors = torch.bmm(pixels, weight.transpose(1, 2))  # [B, D, S]
        else:
            grad_log, grad_colors, behind_here = eager.blend_chunk_backward(
                inputs, pairs, before, behind_here, pixels, work
            )
        if rows is None:
            behind = behind_here
        else:
            behind.index_copy_(0, rows, behind_here)

        packed = sums[here]
        packed[:, MOMENTS : MOMENTS + channels].view(b, s, channels).copy_(grad_colors.transpose(1, 2))
        flat = grad_log.view(-1, PIXELS)
        if sums.shape[1] > MOMENTS + channels:  # absolute gradients of the means
            for column, slope in enumerate(mean_slopes(pairs.coefficients)):
                slope = torch.mm(slope, inputs.basis[:3], out=work.array(0, b, s).view(-1, PIXELS))
                packed[:, MOMENTS + channels + column] = slope.mul_(flat).abs_().sum(-1)
        moments(pairs, torch.mm(inputs.basis, flat.T), packed)


def _blend_region_backward(
    frame: Frame,
    inputs: Inputs,
    tape: list[list[Chunk]],
    final: Tensor,  # [tiles, 64]
    grad_image: Tensor,  # [tiles, D, 64]
    grad_final: Tensor,  # [tiles, 64]
    absgrad: bool,
) -> Tensor:
    """Moments, colour gradients and absolute gradients of the Gaussians from one region, (M, MOMENTS + D [+ 2])."""
    sizes = [sum(chunk.before.shape[0] * chunk.size for chunk in chunks) for chunks in tape]
    total = sum(sizes)
    sums = grad_image.new_empty(total + 1, MOMENTS + inputs.channels + (2 if absgrad else 0))  # in the tape's order
    sums[-1] = 0.0
    place = frame.gaussians.new_empty(total)  # in the pair list
    work = eager.WorkArrays(frame, grad_image)
    for block in zip(tape, place.split(sizes), sums[:-1].split(sizes), strict=True):
        _blend_block_backward(frame, inputs, work, final, grad_image, grad_final, *block)

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
        frame = Frame(footprints, region, means2d.dtype, options.compiled)
        image = colors.new_empty(frame.tiles, colors.shape[1], PIXELS)
        final = colors.new_empty(frame.tiles, PIXELS)
        if frame.occupied < frame.tiles:
            image.zero_()
            final.fill_(1.0)
        needs_grad = any(ctx.needs_input_grad)
        inputs = Inputs.of(means2d, cov2d, det, opacities, colors, options)
        tape = _blend_region(frame, inputs, image, final, needs_grad and keep_lists)
        if needs_grad:
            ctx.save_for_backward(means2d, cov2d, det, opacities, colors, final)
            ctx.kept = (frame, tape) if keep_lists else None
            ctx.arguments = footprints, region, options, absgrad_of
        return image, final

    @staticmethod
    @full_precision
    def backward(ctx, grad_image, grad_final):
        means2d, cov2d, det, opacities, colors, final = ctx.saved_tensors
        footprints, region, options, absgrad_of = ctx.arguments
        inputs = Inputs.of(means2d, cov2d, det, opacities, colors, options)
        if ctx.kept:
            frame, tape = ctx.kept
        else:
            frame = Frame(footprints, region, means2d.dtype, options.compiled)
            tape = _blend_region(frame, inputs, torch.empty_like(grad_image), torch.empty_like(final), True)
        summed = _blend_region_backward(frame, inputs, tape, final, grad_image, grad_final, absgrad_of is not None)
        first, last = MOMENTS, MOMENTS + inputs.channels
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
            is drawn in several regions, one after the other, and their lists are computed again for the
            backward pass.
        absgrad_of: called in the backward pass with the sums over pixels of the absolute gradients
            of means2d, (M, 2).

    Returns:
        Colours (C, H, W, D) over black, and the remaining transmittance (C, H, W, 1).
    """
    cameras, width, height = footprints.cameras, footprints.width, footprints.height
    regions = footprints.regions(max(1, options.memory_budget // bytes_per_pair(colors)))
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
    """Adds up what it is called with, and calls ``receiver`` with the sum at the last of ``calls`` calls."""

    def __init__(self, receiver: Callable[[Tensor], None], calls: int):
        self.receiver, self.left = receiver, calls
        self.total: Tensor | None = None

    def __call__(self, values: Tensor) -> None:
        total = self.total = values if self.total is None else self.total + values
        self.left -= 1
        if self.left == 0:
            self.receiver(total)
