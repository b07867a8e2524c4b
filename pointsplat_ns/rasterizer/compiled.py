"""The two inner kernels of blending, fused by torch's own compiler where the machine has a C++ compiler.

Never needed: without a compiler, with a cache that cannot be written, or after any error of the
compiler, the eager path is used and one line says why. Compiling takes a minute or so, once: torch keeps
the result on disk (``TORCHINDUCTOR_CACHE_DIR``).
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.rasterizer.alpha import alphas_, is_clamped, step
from pointsplat_ns.rasterizer.constants import CHUNK, TILE
from pointsplat_ns.rasterizer.quadratics import COLOR, QUADRATIC

SMALLEST = 8
"""Tiles below which the eager kernels, which take longer chunks, are the faster ones."""


class Kernels(NamedTuple):
    """Compiled :func:`blend_chunk` and :func:`blend_chunk_backward`."""

    forward: Callable[..., tuple[Tensor, Tensor, Tensor]]
    backward: Callable[..., tuple[Tensor, Tensor, Tensor]]


def _alpha(row: Tensor, basis: Tensor, alpha_min: Tensor) -> Tensor:
    """Alphas (B, 64) of one Gaussian a tile, from rows of the table (B, 11 + D)."""
    log2 = row[:, QUADRATIC : QUADRATIC + 1]
    for term in range(1, 6):
        log2 = log2 + row[:, QUADRATIC + term : QUADRATIC + term + 1] * basis[term]
    return alphas_(log2, alpha_min)


def blend_chunk(
    rows: Tensor,  # [B, CHUNK, 11 + D] of the table, with the tile's coefficients
    basis: Tensor,  # [6, 64]
    before: Tensor,  # [B, 64]
    blended: Tensor,  # [B, D, 64]
    last: Tensor,  # [B, 64]
    alpha_min: Tensor,  # []
    transmittance_min: Tensor,  # []
) -> tuple[Tensor, Tensor, Tensor]:
    """Blend CHUNK Gaussians into each tile.

    Returns:
        Transmittance after them (0 where the pixel is finished), colours, and the last transmittance that was not.
    """
    through = before
    colors = list(blended.unbind(1))
    for k in range(CHUNK):
        row = rows[:, k]
        alpha, after = step(_alpha(row, basis, alpha_min), through, transmittance_min)
        weight = alpha * through
        colors = [c + weight * row[:, COLOR + d : COLOR + d + 1] for d, c in enumerate(colors)]
        last = torch.where(after > 0, after, last)
        through = after
    return through, torch.stack(colors, 1), last


def blend_chunk_backward(
    rows: Tensor,  # [B, CHUNK, 11 + D]
    basis: Tensor,  # [6, 64]
    before: Tensor,  # [B, 64]
    behind: Tensor,  # [B, 64] sum over later Gaussians of weight * (color . grad), and the background
    pixels: Tensor,  # [B, D, 64] gradient of the image
    alpha_min: Tensor,  # []
    transmittance_min: Tensor,  # []
) -> tuple[Tensor, Tensor, Tensor]:
    """Gradients of log alpha and weights, (B, CHUNK, 64) each, and ``behind`` for the chunk before."""
    through = before
    alphas, weights = [], []
    for k in range(CHUNK):
        alpha, after = step(_alpha(rows[:, k], basis, alpha_min), through, transmittance_min)
        alphas.append(alpha)
        weights.append(alpha * through)
        through = after
    grads = []
    for k in range(CHUNK - 1, -1, -1):
        shade = pixels[:, 0] * rows[:, k, COLOR : COLOR + 1]
        for d in range(1, pixels.shape[1]):
            shade = shade + pixels[:, d] * rows[:, k, COLOR + d : COLOR + d + 1]
        term = weights[k] * shade
        grad = term - alphas[k] / (1.0 - alphas[k]) * behind
        grads.append(torch.where(is_clamped(alphas[k]), 0.0, grad))
        behind = behind + term
    return torch.stack(grads[::-1], 1), torch.stack(weights, 1), behind


@functools.cache
def kernels(channels: int) -> Kernels | None:
    """Kernels for float32 on a CPU, compiled at the first call for these channels; None and a warning if that fails."""
    try:
        compiled = Kernels(
            torch.compile(blend_chunk, dynamic=True, fullgraph=True),
            torch.compile(blend_chunk_backward, dynamic=True, fullgraph=True),
        )
        with torch.no_grad():
            _check(compiled, channels)
    except Exception as error:  # noqa: BLE001 - whatever the compiler meets, eager works
        reason = str(error).strip().splitlines()
        warnings.warn(
            f"the rasterizer could not be compiled and stays eager: {type(error).__name__}"
            + (f": {reason[0][:200]}" if reason else ""),
            stacklevel=2,
        )
        return None
    return compiled


def _check(compiled: Kernels, channels: int) -> None:
    """Compile for a block of tiles and compare with the functions as they are, so that no miscompilation passes."""
    b, pixels = 2 * SMALLEST + 1, TILE * TILE
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator)

    rows, basis = random(b, CHUNK, COLOR + channels), random(6, pixels)
    rows[..., QUADRATIC:COLOR] *= -2.0
    limits = torch.tensor(0.01), torch.tensor(0.1)
    forward = rows, basis, random(b, pixels), random(b, channels, pixels), random(b, pixels), *limits
    backward = rows, basis, random(b, pixels), random(b, pixels), random(b, channels, pixels), *limits
    cases = [(compiled.forward, blend_chunk, forward), (compiled.backward, blend_chunk_backward, backward)]
    for kernel, plain, arguments in cases:
        for got, wanted in zip(kernel(*arguments), plain(*arguments), strict=True):
            if (got - wanted).abs().gt(1e-4).float().mean() > 1e-3:  # a threshold may fall either way
                raise RuntimeError("the compiled kernel does not agree with the function it was compiled from")
