"""Sums over the pixels of a view, one row a Gaussian, of what a picture alone does not tell.

The rasterizer's own gradients give sums over pixels that are linear in the picture. How many pixels a
Gaussian is drawn on, or the sum of squares of the gradients of each pixel, are not. Here what a view
sees, as the rasterizer projects it, is walked front to back tile by tile, by the rasterizer's rules, and
every pair of Gaussian and pixel is handed to a function.

Shapes: M Gaussians seen, B tiles of a block, L Gaussians in the longest list of the block, 64 pixels a tile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.constants import ALPHA_MAX, ALPHA_MIN, TILE, TRANSMITTANCE_MIN
from pointsplat_ns.rasterizer.projection import Projected
from pointsplat_ns.rasterizer.tiles import Footprints

PIXELS = TILE * TILE
_BLOCK_VALUES = 2**20
"""Values of one (B, L, 64) array: 4 MB in float32, of which a walk holds a dozen."""


class Pairs(NamedTuple):
    """The pairs of a block of tiles, front to back along L. Nothing is drawn where ``alpha`` is zero."""

    ids: Tensor  # [B, L] rows of the projected Gaussians
    alpha: Tensor  # [B, L, 64]
    before: Tensor  # [B, L, 64] transmittance in front of the Gaussian
    final: Tensor  # [B, 64] transmittance behind all that are drawn
    gx: Tensor  # [B, L, 64] d log alpha / d mean x, 1 / pixels
    gy: Tensor  # [B, L, 64]
    clamped: Tensor  # [B, L, 64] where alpha is held at its maximum


def sum_over_pixels(
    seen: Projected, width: int, height: int, columns: int, values: Callable[[Pairs], Tensor]
) -> Tensor:
    """Sum a function of every pair of Gaussian and pixel over the pixels of one view.

    Args:
        seen: what the view sees, M Gaussians.
        width, height: pixels.
        columns: F, numbers a Gaussian.
        values: gives (B, L, F) of a block of pairs: sums over the 64 pixels of each tile.

    Returns:
        (M, F), in the dtype of ``seen``.
    """
    means2d, cov2d, det = seen.means2d.detach(), seen.cov2d.detach(), seen.det.detach()
    total = means2d.new_zeros(len(seen.ids), columns)
    camera = torch.zeros_like(seen.ids)
    footprints = Footprints(means2d, cov2d, det, seen.opacities, seen.depths, camera, 1, width, height)
    lists = footprints.tiles(footprints.whole)
    gaussians, starts, across = lists.gaussians, lists.offsets, footprints.columns
    xx, xy, yy = cov2d.unbind(-1)
    # As the rasterizer keeps it: extent in x given y, and extent in y; both terms are positive.
    shapes = [*means2d.unbind(-1), yy / det, xy / yy, 1.0 / yy, seen.opacities.detach().log()]
    table = torch.stack(shapes, dim=-1)  # (M, 6)
    lengths, order = torch.sort(starts.diff(), descending=True)
    occupied = int((lengths > 0).sum())
    step = torch.arange(TILE, device=means2d.device)
    place_y, place_x = (grid.reshape(-1) for grid in torch.meshgrid(step, step, indexing="ij"))
    begin = 0
    while begin < occupied:
        longest = int(lengths[begin])
        size = max(1, min(_BLOCK_VALUES // (longest * PIXELS), occupied - begin))
        tiles = order[begin : begin + size]
        place = torch.arange(longest, device=tiles.device)
        listed = place < lengths[begin : begin + size, None]  # (B, L)
        ids = gaussians[(starts[tiles, None] + place).clamp_max(gaussians.numel() - 1)]
        pixel_x = (tiles % across * TILE)[:, None] + place_x  # (B, 64)
        pixel_y = torch.div(tiles, across, rounding_mode="floor")[:, None] * TILE + place_y
        inside = (pixel_x < width) & (pixel_y < height)
        pairs = _pairs(table[ids], ids, pixel_x, pixel_y, listed, inside)
        total.index_add_(0, ids[listed], values(pairs)[listed])
        begin += size
    return total


def _pairs(shape: Tensor, ids: Tensor, pixel_x: Tensor, pixel_y: Tensor, listed: Tensor, inside: Tensor) -> Pairs:
    """Alphas and transmittances of a block; ``shape`` is (B, L, 6), pixels are (B, 64), ``listed`` is (B, L)."""
    mx, my, a, r, d, log_opacity = (value[..., None] for value in shape.unbind(-1))
    x, y = pixel_x[:, None] + 0.5 - mx, pixel_y[:, None] + 0.5 - my
    across = x - r * y
    gx = a * across
    alpha = (log_opacity - 0.5 * (gx * across + d * y * y)).exp()
    alpha = torch.where(listed[..., None] & inside[:, None] & (alpha >= ALPHA_MIN), alpha, 0.0)
    clamped = alpha >= ALPHA_MAX
    alpha = alpha.clamp_max(ALPHA_MAX)
    after = torch.cumprod(1 - alpha, dim=1)
    # A pixel is finished before the Gaussian that would bring its transmittance too low.
    alpha = torch.where(after > TRANSMITTANCE_MIN, alpha, 0.0)
    after = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
    return Pairs(ids, alpha, before, after[:, -1], gx, d * y - r * gx, clamped)
