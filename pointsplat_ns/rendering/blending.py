"""Front-to-back alpha blending over tiles, with its own backward pass.

Runs in torch (:mod:`~pointsplat_ns.rendering.blocks`), or with compiled kernels if they were built
(:mod:`~pointsplat_ns.rendering.compiled.blending_kernels`), by the algebra of
:mod:`~pointsplat_ns.rendering.quadratics` and the rule of :mod:`~pointsplat_ns.rendering.alpha`.

Shapes: M Gaussians, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.rendering import blocks
from pointsplat_ns.rendering.compiled import blending_kernels as compiled_blending
from pointsplat_ns.rendering.constants import MEMORY_BUDGET, TILE
from pointsplat_ns.rendering.projection import Projected
from pointsplat_ns.rendering.quadratics import MOMENTS, PIXELS
from pointsplat_ns.rendering.tiles import Footprints
from pointsplat_ns.system.tensors import full_precision


def untiled(values: Tensor, columns: int) -> Tensor:
    """Pixels (H, W, D) from tiles (rows * columns, [D,] 64)."""
    rows = len(values) // columns
    return (
        values.view(rows, columns, -1, TILE, TILE)
        .permute(0, 3, 1, 4, 2)
        .reshape(rows * TILE, columns * TILE, -1)
    )


def tiled(values: Tensor, rows: int, columns: int) -> Tensor:
    """Tiles (rows * columns, D, 64) from pixels (H, W, D), padded with zeros."""
    height, width, channels = values.shape
    whole = values.new_zeros(rows * TILE, columns * TILE, channels)
    whole[:height, :width] = values
    return (
        whole.view(rows, TILE, columns, TILE, channels)
        .permute(0, 2, 4, 1, 3)
        .reshape(-1, channels, PIXELS)
    )


class Blend(torch.autograd.Function):
    """Blend projected Gaussians into rows of tiles; see :func:`blend`."""

    @staticmethod
    def forward(ctx, means2d, cov2d, det, opacities, colors, footprints, rows, keep_lists, absgrad):
        """Lists are stored for the backward pass only if ``keep_lists``."""
        engine = compiled_blending if footprints.compiled else blocks
        grid = footprints.grid
        tiles = footprints.tiles(*rows)
        image = colors.new_empty(tiles.offsets.numel() - 1, colors.shape[1], PIXELS)
        final = colors.new_empty(tiles.offsets.numel() - 1, PIXELS)
        inputs = engine.inputs_of(means2d, cov2d, det, opacities, colors, grid.alpha_min)
        needs_grad = any(ctx.needs_input_grad)
        tape = engine.blend_region(grid, tiles, inputs, image, final, needs_grad and keep_lists)
        if needs_grad:
            ctx.save_for_backward(means2d, cov2d, det, opacities, colors, final)
            ctx.kept = (tiles, tape) if keep_lists else None
            ctx.arguments = footprints, rows, absgrad, engine
        return image, final

    @staticmethod
    @once_differentiable
    @full_precision
    def backward(ctx, grad_image, grad_final):
        means2d, cov2d, det, opacities, colors, final = ctx.saved_tensors
        footprints, rows, absgrad, engine = ctx.arguments
        grid = footprints.grid
        inputs = engine.inputs_of(means2d, cov2d, det, opacities, colors, grid.alpha_min)
        if ctx.kept:
            tiles, tape = ctx.kept
        else:
            tiles = footprints.tiles(*rows)
            again = torch.empty_like(grad_image), torch.empty_like(final)
            tape = engine.blend_region(grid, tiles, inputs, *again, True)
        summed = engine.differentiate_region(
            grid, tiles, inputs, tape, final, grad_image, grad_final, absgrad is not None
        )
        first = MOMENTS
        last = MOMENTS + colors.shape[1]
        if absgrad is not None:
            absgrad[0].index_add_(0, absgrad[1], summed[:, last:])
        grads = engine.chain(summed[:, :first], cov2d, det, opacities)
        return *grads, summed[:, first:last], None, None, None, None


def blend(
    seen: Projected,
    colors: Tensor,
    footprints: Footprints,
    memory_budget: int = MEMORY_BUDGET,
    absgrad: tuple[Tensor, Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians into an image.

    Args:
        seen: M projected Gaussians.
        colors: (M, D), D at most 4 for kernels.
        footprints: of the same Gaussians; made by kernels to blend with kernels.
        memory_budget: bytes of the lists of pairs; a larger image is drawn in several bands, one
            after the other, and the backward pass recomputes their lists.
        absgrad: (K, 2), to which the backward pass adds the sums over pixels of the absolute
            gradients of means2d; and (M,) int64, the rows of the Gaussians in it.

    Returns:
        Colours (H, W, D) over black, and the remaining transmittance (H, W, 1).
    """
    size = colors.element_size()
    # 192 bytes a pair of RGB in float32: lists, tape and gradient sums, which have all channels
    bands = footprints.regions(max(1, memory_budget // (48 * size + (colors.shape[1] - 3) * size)))
    shapes = seen.means2d, seen.cov2d, seen.det, seen.opacities
    drawn = [
        Blend.apply(*shapes, colors, footprints, rows, len(bands) == 1, absgrad) for rows in bands
    ]
    grid = footprints.grid
    image, through = (
        untiled(parts[0] if len(parts) == 1 else torch.cat(parts), grid.columns)[
            : grid.height, : grid.width
        ]
        for parts in zip(*drawn, strict=True)
    )
    return image, through
