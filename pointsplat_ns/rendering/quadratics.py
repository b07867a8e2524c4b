"""The algebra of one Gaussian on one tile: log alpha as a quadratic, and sums of its gradients.

For one tile and one Gaussian, log alpha is a quadratic in the pixel's offset (u, v) from the tile's
centre. All evaluations, and all sums of gradients over pixels, are therefore products with one
6 x 64 matrix of monomials.

The quadratic form is stored as ``a w^2 + d dv^2`` with ``w = du - r dv``, ``r = xy / yy``, ``a = yy
/ det``, ``d = 1 / yy``: the extent in x given y, and the extent in y. Both terms are positive, so a
long needle far from its centre keeps its alpha, without cancellation of huge terms. Logarithms are
to base 2, because torch's ``exp2`` is four times as fast as its ``exp``.

Shapes: B tiles, S pairs per tile, 64 = TILE * TILE pixels, D channels.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.rendering.constants import TILE

PIXELS = TILE * TILE
MOMENTS = 6
"""Number of sums over pixels per pair: of g times w, w^2, dv, dv^2, w dv and 1."""

LOG2E = 1.0 / math.log(2.0)


def basis_of(like: Tensor) -> Tensor:
    """Monomials 1, u, v, u^2, uv, v^2 at the pixel centres of a tile, (6, 64), pixels."""
    axis = torch.arange(TILE, device=like.device, dtype=like.dtype) - (TILE - 1) / 2
    v, u = (grid.reshape(-1) for grid in torch.meshgrid(axis, axis, indexing="ij"))
    return torch.stack([torch.ones_like(u), u, v, u * u, u * v, v * v])


def table_of(
    means2d: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor, colors: Tensor
) -> Tensor:
    """Rows that pairs gather, one per Gaussian, (M + 1, 11 + D); the last row is padding, which is
    never drawn.

    x, y (pixels), r, a, d (log2 per pixels^2), then the coefficients of log2 alpha on the basis, as
    far as they do not depend on the tile, then the colour.
    """
    xx, xy, yy = cov2d.unbind(-1)
    a = LOG2E * yy / det
    r = xy / yy
    d = LOG2E / yy
    ar = a * r
    zero = torch.zeros_like(a)
    columns = [
        *means2d.unbind(-1),
        r,
        a,
        d,
        opacities.log2(),
        zero,
        zero,
        -0.5 * a,
        ar,
        -0.5 * (ar * r + d),
    ]
    table = F.pad(torch.cat([torch.stack(columns, dim=-1), colors], dim=-1), (0, 0, 0, 1))
    table[-1, 5] = -1e4  # log2 alpha of the padding
    return table


class Quadratics(NamedTuple):
    """Quadratics of a chunk of Gaussians in each tile of a block, and the Gaussians' colours."""

    s: Tensor  # [B * S] w at the tile's centre, pixels
    ey: Tensor  # [B * S] dv at the tile's centre, pixels
    r: Tensor  # [B * S]
    coefficients: Tensor  # [B * S, 6] of log2 alpha, on the basis
    colors: Tensor  # [B, S, D]
    rows: Tensor  # [B, S, 11 + D] base of the last two views


def gather(table: Tensor, ids: Tensor, x: Tensor, y: Tensor) -> Quadratics:
    """The quadratics and colours of the pairs ``ids`` (B * S,) of tiles centred at x, y (B,)."""
    rows = table.index_select(0, ids)  # columns: 5 of geometry, 6 coefficients, the colour
    size = ids.numel() // x.numel()
    mx, my, r, a, d = rows[:, :5].unbind(1)
    ey = (y[:, None] - my.view(-1, size)).view(-1)
    s = (x[:, None] - mx.view(-1, size)).view(-1).addcmul_(r, ey, value=-1.0)
    a_s = a * s
    d_ey = d * ey
    quadratic = rows[:, 5:11]
    quadratic[:, 0].addcmul_(a_s, s, value=-0.5).addcmul_(d_ey, ey, value=-0.5)
    torch.neg(a_s, out=quadratic[:, 1])
    torch.sub(a_s.mul_(r), d_ey, out=quadratic[:, 2])
    rows = rows.view(-1, size, rows.shape[1])
    return Quadratics(s, ey, r, quadratic, rows[..., 11:], rows)


def moments(pairs: Quadratics, sums: Tensor, out: Tensor) -> None:
    """The MOMENTS of pairs, where g is the gradient of log alpha (to base e).

    ``sums`` (6, B * S) are the sums of g times the basis. Writes (B * S, 6) columns of ``out``.
    """
    g, gu, gv, guu, guv, gvv = sums
    s, ey, r = pairs[:3]
    q = torch.addcmul(gu, r, gv, value=-1.0)
    h = torch.addcmul(guv, r, gvv, value=-1.0)
    guu.addcmul_(r, guv.add_(h), value=-1.0)
    w, ww, v, vv, wv, one = out.unbind(1)[:MOMENTS]
    one.copy_(g)
    torch.addcmul(q, s, g, out=w)
    torch.addcmul(gv, ey, g, out=v)
    torch.addcmul(guu, s, w + q, out=ww)
    torch.addcmul(gvv, ey, gv.add_(v), out=vv)
    torch.addcmul(h.addcmul_(ey, q), s, v, out=wv)


def mean_slopes(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """d log alpha / d mean x and y as linear functions of (1, u, v), (B * S, 3) each, from the
    coefficients of log2 alpha.

    The gradient of log alpha by the mean is minus its gradient by the pixel.
    """
    _, cu, cv, cuu, cuv, cvv = (coefficients * -math.log(2.0)).unbind(-1)
    return torch.stack([cu, 2 * cuu, cuv], dim=-1), torch.stack([cv, cuv, 2 * cvv], dim=-1)


def chain(
    summed: Tensor, cov2d: Tensor, det: Tensor, opacities: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Gradients of means2d, cov2d, det and opacities from the moments (M, MOMENTS)."""
    w, ww, v, vv, wv, one = summed.unbind(-1)
    xx, xy, yy = cov2d.unbind(-1)
    a = yy / det
    r = xy / yy
    d = 1.0 / yy
    grad_x = a * w
    grad_means2d = torch.stack([grad_x, d * v - r * grad_x], dim=-1)
    grad_a = -0.5 * ww
    grad_r = a * wv
    grad_d = -0.5 * vv
    grad_yy = grad_a / det - (grad_r * r + grad_d * d) * d
    grad_cov2d = torch.stack([torch.zeros_like(xx), grad_r * d, grad_yy], dim=-1)
    grad_det = -grad_a * a / det
    return grad_means2d, grad_cov2d, grad_det, one / opacities
