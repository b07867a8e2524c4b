"""The two inner kernels of blending in plain torch: a chunk of Gaussians into each tile of a block, and back.

Shapes: B tiles of a block, S Gaussians of a chunk, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.alpha import (
    STEP_BY_STEP,
    alphas_,
    is_clamped,
    is_drawn,
    last_transmittance,
    transmittances,
)
from pointsplat_ns.rasterizer.constants import ALPHA_MAX
from pointsplat_ns.rasterizer.quadratics import PIXELS, Quadratics, basis_of, table_of


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
    """Projected Gaussians (M, ...) and their colours (M, D) as blending reads them."""
    table = table_of(means2d, cov2d, det, opacities, colors)
    return Inputs(table, colors.shape[1], bool((opacities > ALPHA_MAX).any()), alpha_min, basis_of(means2d))


class WorkArrays:
    """The work arrays of a block, allocated once: for so many pairs, and so many tiles."""

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
    """``behind`` (B, 64) plus the sum of the terms from each Gaussian on, (B, S + 1, 64), from terms (B, S, 64)."""
    out[:, -1] = behind
    if terms.shape[1] > STEP_BY_STEP:
        torch.add(terms.flip(1).cumsum(1).flip(1), behind[:, None], out=out[:, :-1])
        return out
    sums = out.unbind(1)
    for k, term in reversed(list(enumerate(terms.unbind(1)))):
        torch.add(sums[k + 1], term, out=sums[k])
    return out


def _pass_chunk(inputs: Inputs, pairs: Quadratics, before: Tensor, work: WorkArrays) -> tuple[Tensor, Tensor, Tensor]:
    """Alpha and transmittance of a chunk, for both passes, in the work arrays 0, 1 and that of the transmittances.

    Returns:
        Alphas and 1 - alpha (B, S, 64), and transmittances as if no pixel were ever finished (B, S + 1, 64).
    """
    b, s = pairs.rows.shape[:2]
    alpha = work.array(0, b, s)
    torch.mm(pairs.coefficients, inputs.basis, out=alpha.view(-1, PIXELS))
    alpha = alphas_(alpha, inputs.alpha_min, inputs.may_clamp)
    passing = torch.sub(1.0, alpha, out=work.array(1, b, s))
    return alpha, passing, transmittances(passing, before, work.through(b, s))


def blend_chunk(
    inputs: Inputs, pairs: Quadratics, before: Tensor, last: Tensor, blended: Tensor, work: WorkArrays
) -> tuple[Tensor, Tensor]:
    """Blend S Gaussians into each tile of ``blended`` (B, D, 64), in place.

    Returns:
        Transmittance after them, 0 where the pixel is finished, and the last one that was not, (B, 64) each.
    """
    alpha, passing, through = _pass_chunk(inputs, pairs, before, work)
    weight = alpha.mul_(through[:, :-1])
    after = through[:, -1].clone()
    if bool((~is_drawn(after) & (before > 0)).any()):  # a pixel is finished by this chunk
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
    inputs: Inputs, pairs: Quadratics, before: Tensor, behind: Tensor, pixels: Tensor, work: WorkArrays
) -> tuple[Tensor, Tensor, Tensor]:
    """The backward pass of one chunk.

    Args:
        behind: (B, 64) sum over later Gaussians of weight * (color . grad), and the background.
        pixels: (B, D, 64) gradient of the image.

    Returns:
        Gradients of log alpha (B, S, 64) and of the colours (B, D, S), and ``behind`` for the chunk before.
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
    sums_behind = _sums_behind(weight, behind, out=through)  # the transmittances are no longer needed
    grad_log = weight.addcmul_(odds, sums_behind[:, 1:], value=-1.0)
    if at_clamp is not None:
        grad_log.masked_fill_(at_clamp, 0.0)
    return grad_log, grad_colors, sums_behind[:, 0].clone()
