"""Front-to-back alpha blending over tiles, with its own backward pass.

Done in torch (:mod:`~pointsplat_ns.rasterizer.blocks`), or by compiled kernels where they were built
(:mod:`~pointsplat_ns.rasterizer.compiled.blending`). What is evaluated per pixel, and how gradients are summed, stands
in :mod:`~pointsplat_ns.rasterizer.quadratics`; which Gaussian is drawn on which pixel in
:mod:`~pointsplat_ns.rasterizer.alpha`.

Shapes: M Gaussians, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pointsplat_ns.rasterizer import blocks
from pointsplat_ns.rasterizer.compiled import blending as compiled_blending
from pointsplat_ns.rasterizer.constants import MEMORY_BUDGET, TILE
from pointsplat_ns.rasterizer.projection import Projected
from pointsplat_ns.rasterizer.quadratics import MOMENTS, PIXELS
from pointsplat_ns.rasterizer.tiles import Footprints, Region
from pointsplat_ns.system.tensors import full_precision


def bytes_per_pair(colors: Tensor) -> int:
    """Bytes that a pair of tile and Gaussian takes with colours (M, D): each channel has a gradient sum."""
    size = colors.element_size()
    # 192 bytes a pair of RGB in float32: lists, tape, gradient sums.
    return 192 * size // 4 + (colors.shape[1] - 3) * size


def untiled(values: Tensor, region: Region) -> Tensor:
    """Pixels (H, W, D) of a region's tiles (rows * columns, [D,] 64)."""
    tiles = values.view(region.rows, region.columns, -1, TILE, TILE)
    return tiles.permute(0, 3, 1, 4, 2).reshape(region.rows * TILE, region.columns * TILE, -1)


class Blend(torch.autograd.Function):
    """Blend projected Gaussians into the tiles of one region; see :func:`blend`."""

    @staticmethod
    def forward(ctx, means2d, cov2d, det, opacities, colors, footprints, region, keep_lists, compiled, absgrad_of):
        """The lists are kept for the backward pass only if ``keep_lists``."""
        engine = compiled_blending if compiled_blending.can_blend(colors, compiled) else blocks
        tiles = footprints.tiles(region)
        image = colors.new_empty(tiles.offsets.numel() - 1, colors.shape[1], PIXELS)
        final = colors.new_empty(tiles.offsets.numel() - 1, PIXELS)
        inputs = engine.inputs_of(means2d, cov2d, det, opacities, colors, footprints.alpha_min)
        needs_grad = any(ctx.needs_input_grad)
        tape = engine.blend_region(footprints, tiles, inputs, image, final, needs_grad and keep_lists)
        if needs_grad:
            ctx.save_for_backward(means2d, cov2d, det, opacities, colors, final)
            ctx.kept = (tiles, tape) if keep_lists else None
            ctx.arguments = footprints, region, absgrad_of, engine
        return image, final

    @staticmethod
    @once_differentiable
    @full_precision
    def backward(ctx, grad_image, grad_final):
        means2d, cov2d, det, opacities, colors, final = ctx.saved_tensors
        footprints, region, absgrad_of, engine = ctx.arguments
        inputs = engine.inputs_of(means2d, cov2d, det, opacities, colors, footprints.alpha_min)
        if ctx.kept:
            tiles, tape = ctx.kept
        else:
            tiles = footprints.tiles(region)
            again = torch.empty_like(grad_image), torch.empty_like(final)
            tape = engine.blend_region(footprints, tiles, inputs, *again, True)
        summed = engine.differentiate_region(
            footprints, tiles, inputs, tape, final, grad_image, grad_final, absgrad_of is not None
        )
        first, last = MOMENTS, MOMENTS + inputs.channels
        if absgrad_of is not None:
            absgrad_of(summed[:, last:])
        grads = engine.chain(summed[:, :first], cov2d, det, opacities)
        return *grads, summed[:, first:last], None, None, None, None, None


def blend(
    seen: Projected,
    colors: Tensor,
    footprints: Footprints,
    compiled: bool | None = None,
    memory_budget: int = MEMORY_BUDGET,
    absgrad_of: Callable[[Tensor], None] | None = None,
) -> tuple[Tensor, Tensor]:
    """Blend Gaussians into an image.

    Args:
        seen: M projected Gaussians.
        colors: (M, D)
        footprints: of the same Gaussians.
        compiled: as for :func:`~pointsplat_ns.rasterization`.
        memory_budget: an image whose lists of pairs would take more bytes is drawn in several regions, one after the
            other, and their lists are computed again for the backward pass.
        absgrad_of: called in the backward pass with the sums over pixels of the absolute gradients
            of means2d, (M, 2).

    Returns:
        Colours (H, W, D) over black, and the remaining transmittance (H, W, 1).
    """
    regions = footprints.regions(max(1, memory_budget // bytes_per_pair(colors)))

    def assemble(parts: list[Tensor]) -> Tensor:
        """Regions run through rows of tiles, or through the columns of one row."""
        bands, row = [], []
        for part, region in zip(parts, regions, strict=True):
            row.append(untiled(part, region))
            if region.right == footprints.columns:
                bands.append(torch.cat(row, dim=1) if len(row) > 1 else row[0])
                row = []
        whole = torch.cat(bands) if len(bands) > 1 else bands[0]
        return whole[: footprints.height, : footprints.width]

    absolute: list[Tensor] = []

    def collect(values: Tensor) -> None:
        absolute.append(values)
        if absgrad_of is not None and len(absolute) == len(regions):
            absgrad_of(sum(absolute[1:], start=absolute[0]))
            absolute.clear()

    images, finals = [], []
    for region in regions:
        image, final = Blend.apply(
            seen.means2d, seen.cov2d, seen.det, seen.opacities, colors, footprints, region, len(regions) == 1, compiled,
            None if absgrad_of is None else collect,
        )  # fmt: skip
        images.append(image)
        finals.append(final)
    return assemble(images), assemble(finals)
