"""Deterministic selection of exactly K Gaussians by their scores."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError


def select(scores: Tensor, k: int) -> Tensor:
    """Indices of the ``k`` highest scores.

    Of equal scores, the lower index is taken first; NaN ranks below every number.

    Args:
        scores: (N,), any floating type; +-Inf allowed.
        k: number of indices, 0 to N.

    Returns:
        Indices (k,) int64, ascending.

    Raises:
        BudgetError: if ``k`` is not in 0..N.
    """
    n = scores.shape[0]
    if not 0 <= k <= n:
        raise BudgetError(f"cannot select {k} of {n} Gaussians; expected 0 to {n}")
    number = ~scores.isnan()
    numbers = int(number.sum())
    if k == 0:
        chosen = torch.zeros_like(number)
    elif k >= numbers:
        chosen = number | _first(~number, k - numbers)
    else:
        # Keep all above the k-th highest score, and the first of those equal to it.
        threshold = scores[number].kthvalue(numbers - k + 1).values
        above = scores > threshold
        chosen = above | _first(scores == threshold, k - int(above.sum()))
    return chosen.nonzero()[:, 0]


def _first(mask: Tensor, count: int) -> Tensor:
    """``mask`` (N,) with only its first ``count`` true entries left true."""
    left = torch.zeros_like(mask)
    left[mask.nonzero()[:count, 0]] = True
    return left
