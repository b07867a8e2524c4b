"""Alpha and transmittance: which Gaussian is drawn on which pixel, and with which weight.

Alpha is ``min(ALPHA_MAX, opacity * exp(-sigma))``, where sigma is half the squared Mahalanobis
distance of the pixel. A Gaussian is not drawn on a pixel if its alpha is below a threshold. From
front to back, each drawn Gaussian multiplies the transmittance by ``1 - alpha``; a pixel is
finished before the Gaussian that would bring it to a second threshold or less. (3DGS, section 6;
the thresholds are in :mod:`~pointsplat_ns.rendering.constants`.)

The compiled kernels (``blending.cpp``) and ``lab/numerics/reference.py``, which checks both,
implement the same rule.

Shapes: B tiles, S Gaussians of a chunk from front to back, 64 pixels per tile.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.rendering.constants import ALPHA_MAX, TRANSMITTANCE_MIN

CLAMPED = ALPHA_MAX * (1 - 1e-6)
"""Alphas from here on count as clamped; the margin covers the rounding of ALPHA_MAX to float32."""

STEP_BY_STEP = 64
"""Largest chunk that is scanned one Gaussian at a time; longer chunks use fewer, larger
operations."""


def alphas_(log2_alpha: Tensor, alpha_min: float, may_clamp: bool = True) -> Tensor:
    """Alphas, 0 if a Gaussian is not drawn, in place of their unclamped logarithms to base 2.

    Args:
        log2_alpha: any shape, overwritten.
        alpha_min: alphas up to this are not drawn.
        may_clamp: False saves a pass if no opacity exceeds ALPHA_MAX.
    """
    alpha = log2_alpha.exp2_()
    if may_clamp:
        alpha = alpha.clamp_(max=ALPHA_MAX)
    return F.threshold(alpha, alpha_min, 0.0, inplace=True)


def is_clamped(alpha: Tensor) -> Tensor:
    """Mask of alphas clamped to ALPHA_MAX, which have no gradient."""
    return alpha >= CLAMPED


def is_drawn(after: Tensor, out: Tensor | None = None) -> Tensor:
    """Mask of the pixels that a Gaussian does not finish, from the transmittance behind it; as 0
    and 1 in ``out`` if given."""
    return torch.gt(after, TRANSMITTANCE_MIN, out=out)


def transmittances(passing: Tensor, before: Tensor, out: Tensor) -> Tensor:
    """Transmittance in front of each Gaussian of a chunk and behind the last, ignoring that pixels
    are finished.

    Args:
        passing: (B, S, 64), 1 - alpha.
        before: (B, 64), in front of the first.
        out: (B, S + 1, 64), written and returned.
    """
    out[:, 0] = before
    size = 16  # Gaussians per group
    if passing.shape[1] <= STEP_BY_STEP or passing.shape[1] % size:
        steps = out.unbind(1)
        for k, factor in enumerate(passing.unbind(1)):
            torch.mul(steps[k], factor, out=steps[k + 1])
        return out
    # products of all groups at a time, then group by group
    groups = out[:, 1:].unflatten(1, (-1, size))
    steps = groups.unbind(2)
    factors = passing.unflatten(1, (-1, size)).unbind(2)
    steps[0].copy_(factors[0])
    for k in range(1, size):
        torch.mul(steps[k - 1], factors[k], out=steps[k])
    for group in groups.unbind(1):
        group.mul_(before[:, None])
        before = group[:, -1]
    return out


def last_transmittance(through: Tensor, drawn: Tensor) -> Tensor:
    """Transmittance (B, 64) behind the last drawn Gaussian.

    Args:
        through: (B, S + 1, 64) of :func:`transmittances`.
        drawn: (B, S, 64), 0 or 1 or boolean, of :func:`is_drawn` of ``through[:, 1:]``.
    """
    return through.gather(1, drawn.sum(1, keepdim=True).long())[:, 0]
