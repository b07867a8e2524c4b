"""Sums over the pixels of a view, for each Gaussian, that are not gradients of the image.

For example the number of pixels on which a Gaussian is drawn, or the sum of squared per-pixel
gradients. The projected Gaussians of a view are processed front to back, tile by tile, by the
rasterizer's rules.

Shapes: M visible Gaussians, B tiles of a block, L Gaussians in the longest list of the block, 64
pixels per tile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rendering.alpha import (
    alphas_,
    is_clamped,
    is_drawn,
    last_transmittance,
    transmittances,
)
from pointsplat_ns.rendering.constants import ALPHA_MIN, TILE
from pointsplat_ns.rendering.projection import Projected
from pointsplat_ns.rendering.quadratics import LOG2E, PIXELS
from pointsplat_ns.rendering.tiles import Footprints


class PixelBlock(NamedTuple):
    """Every Gaussian of a block of tiles on every pixel, front to back along L. Where ``alpha`` is
    zero the Gaussian is not drawn, and ``before`` is undefined."""

    ids: Tensor  # [B, L] rows of the projected Gaussians
    alpha: Tensor  # [B, L, 64]
    before: Tensor  # [B, L, 64] transmittance in front of the Gaussian
    final: Tensor  # [B, 64] transmittance behind all drawn Gaussians
    gx: Tensor  # [B, L, 64] d log alpha / d mean x, 1 / pixels
    gy: Tensor  # [B, L, 64]
    clamped: Tensor  # [B, L, 64] where alpha is clamped to its maximum


def sum_over_pixels(
    seen: Projected, width: int, height: int, columns: int, values: Callable[[PixelBlock], Tensor]
) -> Tensor:
    """Sum a function of every pair of Gaussian and pixel over the pixels of one view.

    Args:
        seen: M Gaussians, projected to the view.
        width, height: pixels.
        columns: F, values per Gaussian.
        values: returns (B, L, F) for a block of pairs: sums over the 64 pixels of each tile.

    Returns:
        (M, F), in the dtype of ``seen``.
    """
    means2d = seen.means2d.detach()
    cov2d = seen.cov2d.detach()
    det = seen.det.detach()
    total = means2d.new_zeros(len(seen.ids), columns)
    footprints = Footprints(seen, width, height, compiled=False)
    lists = footprints.tiles()
    gaussians = lists.gaussians
    starts = lists.offsets
    across = footprints.grid.columns
    xx, xy, yy = cov2d.unbind(-1)
    # As in the rasterizer: extent in x given y, and extent in y; both terms are positive.
    shapes = [*means2d.unbind(-1), yy / det, xy / yy, 1.0 / yy, seen.opacities.detach().log2()]
    table = torch.stack(shapes, dim=-1)  # (M, 6)
    lengths, order = torch.sort(starts.diff(), descending=True)
    occupied = int((lengths > 0).sum())
    step = torch.arange(TILE, device=means2d.device, dtype=torch.int64)
    place_y, place_x = (grid.reshape(-1) for grid in torch.meshgrid(step, step, indexing="ij"))
    begin = 0
    while begin < occupied:
        longest = int(lengths[begin])
        # Arrays (B, L, 64) of 4 MB in float32; a walk needs a dozen of them.
        size = max(1, min(2**20 // (longest * PIXELS), occupied - begin))
        tiles = order[begin : begin + size]
        place = torch.arange(longest, device=tiles.device, dtype=torch.int64)
        listed = place < lengths[begin : begin + size, None]  # (B, L)
        ids = gaussians[(starts[tiles, None] + place).clamp_max(gaussians.numel() - 1)]
        pixel_x = (tiles % across * TILE)[:, None] + place_x  # (B, 64)
        pixel_y = torch.div(tiles, across, rounding_mode="floor")[:, None] * TILE + place_y
        inside = (pixel_x < width) & (pixel_y < height)
        block = _walk(table[ids], ids, pixel_x, pixel_y, listed, inside)
        total.index_add_(0, ids[listed], values(block)[listed])
        begin += size
    return total


def _walk(
    shape: Tensor, ids: Tensor, pixel_x: Tensor, pixel_y: Tensor, listed: Tensor, inside: Tensor
) -> PixelBlock:
    """Alphas and transmittances of a block; ``shape`` is (B, L, 6), pixels are (B, 64), ``listed``
    is (B, L)."""
    mx, my, a, r, d, log2_opacity = (value[..., None] for value in shape.unbind(-1))
    x, y = (
        pixel[:, None].to(mx.dtype) + 0.5 - mean for pixel, mean in ((pixel_x, mx), (pixel_y, my))
    )
    across = x - r * y
    gx = a * across
    log2_alpha = log2_opacity - 0.5 * LOG2E * (gx * across + d * y * y)
    alpha = alphas_(
        torch.where(listed[..., None] & inside[:, None], log2_alpha, -torch.inf), ALPHA_MIN
    )
    clamped = is_clamped(alpha)
    through = alpha.new_empty(alpha.shape[0], alpha.shape[1] + 1, PIXELS)
    transmittances(1.0 - alpha, torch.ones_like(alpha[:, 0]), out=through)
    drawn = is_drawn(through[:, 1:])
    final = last_transmittance(through, drawn)
    return PixelBlock(ids, alpha.mul_(drawn), through[:, :-1], final, gx, d * y - r * gx, clamped)
