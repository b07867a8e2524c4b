"""Front-to-back alpha blending over tiles, with its own backward pass.

For one tile and one Gaussian the logarithm of alpha is a quadratic in the pixel's offset (u, v) from
the tile's centre. All evaluations, and all sums of gradients over pixels, are therefore products
with one 6 x 64 matrix of monomials. Tiles of similar length are blended together in blocks that fit
the cache, CHUNK Gaussians at a time; tiles whose every pixel is saturated are dropped in between.

The quadratic form is kept as ``a (dx - r dy)^2 + d dy^2`` with ``r = xy / yy``, ``a = yy / det``,
``d = 1 / yy``: the extent in x given y, and the extent in y. Both terms are positive, so a long
needle far from its centre does not lose its alpha to the cancellation of huge terms.

Shapes: P pairs, B tiles of a block, S = CHUNK, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.rasterizer.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    CHUNK,
    LOG_ALPHA_MAX,
    LOG_ALPHA_MIN,
    TILE,
    TRANSMITTANCE_MIN,
)
from pointsplat_ns.rasterizer.tiles import TileList

PIXELS = TILE * TILE
_BLOCK_VALUES = 2**18  # values of one (S, B, 64) work array on a CPU: 1 MB in float32, near the L2 cache
_BLOCK_VALUES_GPU = 2**24
_NEVER = -1e4  # log alpha of the padding


class _Chunk(NamedTuple):
    """What the backward pass keeps of one chunk of one block."""

    tiles: Tensor  # [B] rows of the sorted tile order
    first: int  # place in each tile's list
    transmittance: Tensor  # [B, 64] before the chunk; 0 where the pixel is finished


def _basis(like: Tensor) -> Tensor:
    """Monomials 1, u, v, u^2, uv, v^2 at the pixel centres of a tile, (6, 64), pixels."""
    axis = torch.arange(TILE, device=like.device, dtype=like.dtype) - (TILE - 1) / 2
    v, u = (grid.reshape(-1) for grid in torch.meshgrid(axis, axis, indexing="ij"))
    return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v])


class _Shape(NamedTuple):
    """The parameters of Gaussians as pairs see them, each (...,); a, r and d as the module says."""

    x: Tensor  # mean, pixels
    y: Tensor
    a: Tensor  # 1 / pixels^2
    r: Tensor
    d: Tensor  # 1 / pixels^2
    log_opacity: Tensor

    @classmethod
    def of(cls, means2d: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor) -> _Shape:
        xx, xy, yy = cov2d.unbind(-1)
        return cls(means2d[:, 0], means2d[:, 1], yy / det, xy / yy, 1.0 / yy, opacities.log())


def _coefficients(shape: _Shape, tile_x: Tensor, tile_y: Tensor) -> Tensor:
    """Log alpha as coefficients of the basis, (6, S, B)."""
    ex, ey = tile_x - shape.x, tile_y - shape.y
    a, r, d = shape.a, shape.r, shape.d
    s = ex - r * ey
    a_s, a_r = a * s, a * r
    return torch.stack(
        [
            shape.log_opacity - 0.5 * (a_s * s + d * ey * ey),
            -a_s,
            a_s * r - d * ey,
            -0.5 * a,
            a_r,
            -0.5 * (a_r * r + d),
        ]
    )


def _coefficients_backward(shape: _Shape, tile_x: Tensor, tile_y: Tensor, grad: Tensor) -> _Shape:
    """Gradients of the shape from gradients (..., 6) of the coefficients."""
    g1, gu, gv, guu, guv, gvv = grad.unbind(-1)
    ex, ey = tile_x - shape.x, tile_y - shape.y
    a, r, d = shape.a, shape.r, shape.d
    s = ex - r * ey
    grad_a = -0.5 * (g1 * s * s + guu + gvv * r * r) - gu * s + gv * r * s + guv * r
    grad_d = -0.5 * (g1 * ey * ey + gvv) - gv * ey
    grad_s = a * (gv * r - g1 * s - gu)
    grad_r = a * (gv * s + guv - gvv * r) - grad_s * ey
    grad_ey = -grad_s * r - d * (g1 * ey + gv)
    return _Shape(-grad_s, -grad_ey, grad_a, grad_r, grad_d, g1)


class _Frame:
    """Index arithmetic that forward and backward share."""

    def __init__(self, tiles: TileList, count: int, width: int, height: int, dtype: torch.dtype):
        lengths = tiles.offsets[1:] - tiles.offsets[:-1]
        self.lengths, self.order = torch.sort(lengths, descending=True, stable=True)
        self.starts = tiles.offsets[:-1][self.order]
        within = self.order % (tiles.rows * tiles.columns)
        row, column = within // tiles.columns, within % tiles.columns
        self.x = (column * TILE + TILE // 2).to(dtype)  # tile centres, pixels
        self.y = (row * TILE + TILE // 2).to(dtype)
        self.gaussians = tiles.gaussians
        self.padded_gaussians = torch.cat([tiles.gaussians, tiles.gaussians.new_full((1,), count)])
        self.occupied = int((lengths > 0).sum())
        axis = torch.arange(TILE, device=lengths.device)
        inside_x = column[:, None] * TILE + axis < width
        inside_y = row[:, None] * TILE + axis < height
        self.inside = (inside_y[:, :, None] & inside_x[:, None, :]).reshape(-1, PIXELS)  # [tiles, 64]

    def pairs(self, tiles: Tensor, first: int) -> tuple[Tensor, Tensor]:
        """For tiles [B]: places in the pair list, and the Gaussians there, both [S * B].

        Where a tile's list has ended the place is one past all pairs and the Gaussian is the table's padding.
        """
        step = torch.arange(first, first + CHUNK, device=tiles.device)[:, None]
        ended = step >= self.lengths[tiles]
        place = (self.starts[tiles] + step).masked_fill_(ended, self.gaussians.numel()).view(-1)
        ids = self.padded_gaussians.index_select(0, place)
        return place, ids


def _table(shape: _Shape, colors: Tensor) -> tuple[Tensor, Tensor]:
    """What a pair gathers: shapes (6, M + 1) and colours (M + 1, D); the last is the padding, which is never seen."""
    rows = torch.nn.functional.pad(torch.stack(shape), (0, 1))
    rows[5, -1] = _NEVER
    return rows, torch.nn.functional.pad(colors, (0, 0, 0, 1))


def _alphas(coefficients: Tensor, basis: Tensor, work: Tensor) -> Tensor:
    """Alphas (S, B, 64) from coefficients (6, S, B), written into ``work``."""
    _, s, b = coefficients.shape
    alpha = torch.mm(coefficients.view(6, s * b).T, basis, out=work[: s * b])
    alpha.clamp_(LOG_ALPHA_MIN - 1.0, LOG_ALPHA_MAX).exp_()  # the floor keeps denormals away
    F.threshold_(alpha, ALPHA_MIN, 0.0)
    return alpha.view(s, b, PIXELS)


def _transmittances(alpha: Tensor, before: Tensor, work: Tensor) -> tuple[Tensor, Tensor]:
    """Transmittance before each Gaussian and after the last, (S + 1, B, 64), and 1 - alpha (S, B, 64)."""
    passing = 1.0 - alpha
    through = work[: CHUNK + 1, : alpha.shape[1]]
    through[0] = before
    for k in range(CHUNK):
        torch.mul(through[k], passing[k], out=through[k + 1])
    return through, passing


def _work(frame: _Frame, like: Tensor) -> tuple[int, Tensor, Tensor]:
    """Tiles in a block, and the two work arrays of a block."""
    values = _BLOCK_VALUES_GPU if like.is_cuda else _BLOCK_VALUES
    block = max(1, min(values // (CHUNK * PIXELS), frame.occupied))
    return block, like.new_empty(CHUNK * block, PIXELS), like.new_empty(CHUNK + 1, block, PIXELS)


class Blend(torch.autograd.Function):
    """Blend sorted 2D Gaussians into tiles; see :func:`blend`."""

    @staticmethod
    def forward(ctx, means2d, cov2d, det, opacities, colors, tiles, width, height, absgrad_of):
        count, channels = colors.shape
        frame = _Frame(tiles, count, width, height, means2d.dtype)
        shapes, shades = _table(_Shape.of(means2d, cov2d, det, opacities), colors)
        basis = _basis(means2d)
        image = colors.new_zeros(frame.order.numel(), PIXELS, channels)
        final = colors.new_ones(frame.order.numel(), PIXELS)
        keep_tape = any(ctx.needs_input_grad)
        tape: list[list[_Chunk]] = []
        block, work, work_t = _work(frame, means2d)

        for begin in range(0, frame.occupied, block):
            rows = torch.arange(begin, min(begin + block, frame.occupied), device=means2d.device)
            longest = int(frame.lengths[begin])
            through = frame.inside[rows].to(means2d.dtype)
            blended = colors.new_zeros(rows.numel(), PIXELS, channels)
            last = torch.ones_like(through)
            chunks: list[_Chunk] = []
            for first in range(0, longest, CHUNK):
                if keep_tape:
                    chunks.append(_Chunk(rows, first, through))
                _, ids = frame.pairs(rows, first)
                pair = _Shape(*shapes.index_select(1, ids).view(6, CHUNK, -1))
                shade = shades.index_select(0, ids).view(CHUNK, -1, channels)
                alpha = _alphas(_coefficients(pair, frame.x[rows], frame.y[rows]), basis, work)
                steps, _ = _transmittances(alpha, through, work_t)
                weight = alpha * steps[:-1]
                through = steps[-1].clone()
                saturated = bool((through <= TRANSMITTANCE_MIN).any())
                if saturated:
                    open_ = steps > TRANSMITTANCE_MIN
                    weight.mul_(open_[1:])
                    still = torch.where(open_, steps, steps.new_tensor(torch.inf)).amin(0)
                    last = torch.minimum(last, still)
                    through.mul_(open_[-1])
                else:
                    last = torch.minimum(last, through)
                blended += torch.bmm(weight.permute(1, 2, 0), shade.permute(1, 0, 2))
                if first + CHUNK >= longest:
                    break
                alive = frame.lengths[rows] > first + CHUNK
                if saturated:
                    alive &= (through > 0).any(-1)
                left = int(alive.sum())
                if left == 0:
                    break
                if left <= 0.9 * rows.numel():
                    image[rows], final[rows] = blended, last
                    rows, through = rows[alive], through[alive]
                    blended, last = blended[alive], last[alive]
            image[rows], final[rows] = blended, last
            tape.append(chunks)

        if keep_tape:
            ctx.save_for_backward(means2d, cov2d, det, opacities, colors, final)
            ctx.frame, ctx.tape, ctx.absgrad_of = frame, tape, absgrad_of
        inverse = torch.empty_like(frame.order)
        inverse[frame.order] = torch.arange(frame.order.numel(), device=inverse.device)
        return image[inverse], final[inverse]

    @staticmethod
    def backward(ctx, grad_image, grad_final):
        means2d, cov2d, det, opacities, colors, final = ctx.saved_tensors
        frame, absgrad_of = ctx.frame, ctx.absgrad_of
        grad_image, grad_final = grad_image[frame.order], grad_final[frame.order]
        shape = _Shape.of(means2d, cov2d, det, opacities)
        shapes, shades = _table(shape, colors)
        basis = _basis(means2d)
        channels = colors.shape[1]
        columns = 6 + channels + (2 if absgrad_of is not None else 0)
        pair_grads = colors.new_zeros(frame.padded_gaussians.numel(), columns)
        _, work, work_t = _work(frame, means2d)
        # alpha was clamped only where an opacity exceeds the clamp
        clamped = bool((opacities > ALPHA_MAX).any())

        for chunks in reversed(ctx.tape):
            begin, size = int(chunks[0].tiles[0]), chunks[0].tiles.numel()
            # what lies behind: sum over later Gaussians of weight * (color . grad), and the background
            behind = grad_final[begin : begin + size] * final[begin : begin + size]
            for tiles, first, before in reversed(chunks):
                b = tiles.numel()
                place, ids = frame.pairs(tiles, first)
                pair = _Shape(*shapes.index_select(1, ids).view(6, CHUNK, b))
                color = shades.index_select(0, ids).view(CHUNK, b, channels)
                tile_x, tile_y = frame.x[tiles], frame.y[tiles]
                coefficients = _coefficients(pair, tile_x, tile_y)
                alpha = _alphas(coefficients, basis, work)
                steps, passing = _transmittances(alpha, before, work_t)
                if bool((steps[-1] <= TRANSMITTANCE_MIN).any()):
                    alpha.mul_(steps[1:] > TRANSMITTANCE_MIN)
                weight = alpha * steps[:-1]

                grad_pixels = grad_image[tiles]  # [B, 64, D]
                grad_colors = torch.bmm(weight.permute(1, 0, 2), grad_pixels).permute(1, 0, 2)
                shade = torch.bmm(color.permute(1, 0, 2), grad_pixels.transpose(1, 2))
                weight.mul_(shade.permute(1, 0, 2))  # weight * (color . grad), [S, B, 64]

                suffix = steps  # the transmittances are no longer needed
                suffix[CHUNK] = behind[tiles - begin]
                for k in range(CHUNK - 1, -1, -1):
                    torch.add(suffix[k + 1], weight[k], out=suffix[k])
                behind[tiles - begin] = suffix[0]
                at_clamp = alpha >= ALPHA_MAX * (1 - 1e-6) if clamped else None
                grad_log = weight.addcmul_(alpha.div_(passing), suffix[1:], value=-1.0)
                if at_clamp is not None:
                    grad_log.masked_fill_(at_clamp, 0.0)

                flat = grad_log.view(CHUNK * b, PIXELS)
                packed = flat.new_empty(CHUNK * b, columns)
                packed[:, :6] = flat @ basis.T
                packed[:, 6 : 6 + channels] = grad_colors.reshape(CHUNK * b, channels)
                if absgrad_of is not None:
                    for column, slope in enumerate(_mean_slopes(coefficients)):
                        slope = torch.mm(slope.view(3, -1).T, basis[:3], out=work[: CHUNK * b])
                        packed[:, 6 + channels + column] = slope.mul_(flat).abs_().sum(-1)
                pair_grads.index_copy_(0, place, packed)

        return _gather_gradients(frame, shape, pair_grads[:-1], cov2d, det, opacities, channels, absgrad_of)


def _mean_slopes(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """d log alpha / d mean x and y as linear functions of (1, u, v), (3, S, B) each, from (6, S, B).

    The gradient of log alpha by the mean is minus its gradient by the pixel.
    """
    _, cu, cv, cuu, cuv, cvv = coefficients
    return torch.stack([-cu, -2 * cuu, -cuv]), torch.stack([-cv, -cuv, -2 * cvv])


def _gather_gradients(frame, shape, pair_grads, cov2d, det, opacities, channels, absgrad_of):
    """Turn gradients of pairs into gradients of the Gaussians (the inputs of ``forward``)."""
    count = det.shape[0]
    tile = torch.repeat_interleave(frame.lengths)  # in order of length: bring it to the order of the list
    place = torch.arange(tile.numel(), device=tile.device)
    place = place - (torch.cumsum(frame.lengths, 0) - frame.lengths)[tile] + frame.starts[tile]
    tile_of_pair = torch.empty_like(tile)
    tile_of_pair[place] = tile

    of_pair = _Shape(*torch.stack(shape, dim=-1).index_select(0, frame.gaussians).unbind(-1))
    tile_x, tile_y = frame.x[tile_of_pair], frame.y[tile_of_pair]
    chained = _coefficients_backward(of_pair, tile_x, tile_y, pair_grads[:, :6])
    rows = torch.cat([torch.stack(chained, dim=-1), pair_grads[:, 6:]], dim=-1)
    summed = _segment_sum(rows, frame.gaussians, count)

    gx, gy, ga, gr, gd, glog = summed[:, :6].unbind(-1)
    xx, xy, yy = cov2d.unbind(-1)
    grad_means2d = torch.stack([gx, gy], dim=-1)
    grad_yy = ga / det - gr * xy / (yy * yy) - gd / (yy * yy)
    grad_cov2d = torch.stack([torch.zeros_like(xx), gr / yy, grad_yy], dim=-1)
    grad_det = -ga * yy / (det * det)
    grad_colors = summed[:, 6 : 6 + channels]
    if absgrad_of is not None:
        absgrad_of(summed[:, 6 + channels :])
    return grad_means2d, grad_cov2d, grad_det, glog / opacities, grad_colors, None, None, None, None


def _segment_sum(rows: Tensor, ids: Tensor, count: int) -> Tensor:
    """Sum rows (P, F) by ids (P,) into (count, F), in a fixed order."""
    if rows.shape[0] == 0:
        return rows.new_zeros(count, rows.shape[1])
    _, order = torch.sort(ids.to(torch.int32), stable=True)
    offsets = torch.cumsum(torch.bincount(ids, minlength=count), 0)
    offsets = torch.cat([offsets.new_zeros(1), offsets[:-1]])
    return F.embedding_bag(order, rows, offsets, mode="sum")


def blend(
    means2d: Tensor,  # [M, 2] pixels
    cov2d: Tensor,  # [M, 3] xx, xy, yy, pixels^2
    det: Tensor,  # [M] determinant of cov2d
    opacities: Tensor,  # [M] in (0, 1]
    colors: Tensor,  # [M, D]
    tiles: TileList,
    cameras: int,
    width: int,
    height: int,
    absgrad_of=None,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians into images.

    Args:
        absgrad_of: called in the backward pass with the sums over pixels of the absolute gradients
            of means2d, (M, 2).

    Returns:
        Colours (C, H, W, D) over black, and the remaining transmittance (C, H, W, 1).
    """
    image, final = Blend.apply(means2d, cov2d, det, opacities, colors, tiles, width, height, absgrad_of)

    def untile(values: Tensor) -> Tensor:
        values = values.view(cameras, tiles.rows, tiles.columns, TILE, TILE, -1).permute(0, 1, 3, 2, 4, 5)
        return values.reshape(cameras, tiles.rows * TILE, tiles.columns * TILE, -1)[:, :height, :width]

    return untile(image), untile(final)
