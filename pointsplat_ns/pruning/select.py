"""Keeping exactly K Gaussians, always the same ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.budget import Keep, resolve_keep
from pointsplat_ns.pruning.coverage import coverage_score
from pointsplat_ns.pruning.scores import (
    area_score,
    authors_score,
    log_volume_score,
    opacity_score,
    paper_score,
    random_score,
    volume_score,
)

SCORES: dict[str, Callable[..., Tensor]] = {
    "coverage": coverage_score,
    "paper": paper_score,
    "authors": authors_score,
    "opacity": opacity_score,
    "volume": volume_score,
    "log-volume": log_volume_score,
    "area": area_score,
    "random": random_score,
}
"""Scores by name; each takes the scene and keyword options of its own."""

WEIGHTED = ("paper", "authors", "log-volume")
"""Those that take ``opacity_weight``."""


@dataclass(frozen=True, eq=False)
class Pruned:
    """What a pruning kept."""

    scene: Gaussians
    """K Gaussians, bit for bit as they were, in their old order."""
    indices: Tensor  # [K] int64, ascending, into the dense scene
    scores: Tensor  # [N] float64, of the dense scene


def select(scores: Tensor, k: int) -> Tensor:
    """Indices of the ``k`` highest scores.

    Equal scores go to the lower index first; NaN comes after every number.

    Args:
        scores: (N,), any floating type; +-Inf allowed.
        k: how many, 0 to N.

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
        # The k-th highest score splits the scene: all above it stay, and the first of those equal to it.
        threshold = scores[number].kthvalue(numbers - k + 1).values
        above = scores > threshold
        chosen = above | _first(scores == threshold, k - int(above.sum()))
    return chosen.nonzero()[:, 0]


def prune(scene: Gaussians, keep: Keep, by: str = "paper", **options: Any) -> Pruned:
    """Keep the best of a scene.

    Args:
        scene: N Gaussians.
        keep: ratio, count or size (see :func:`~pointsplat_ns.pruning.budget.resolve_keep`).
        by: name of a score in :data:`SCORES`.
        **options: options of that score.

    Returns:
        Exactly the resolved number of Gaussians.

    Raises:
        BudgetError: if no such number can be kept.
        SceneError: if no Gaussian of the scene can be drawn.
        PointSplatError: if there is no such score.
    """
    if by not in SCORES:
        raise PointSplatError(f"no score is called {by!r}; expected one of {', '.join(SCORES)}")
    k = resolve_keep(len(scene), keep, scene.sh_degree)
    need_usable(scene)
    with torch.no_grad():
        scores = SCORES[by](scene, **options)
        indices = select(scores, k)
    return Pruned(scene[indices], indices, scores)


def need_usable(scene: Gaussians) -> None:
    """Make sure that a scene has something to keep.

    Raises:
        SceneError: if no Gaussian of it can be drawn.
    """
    if not bool(scene.usable().any()):
        raise SceneError(f"none of the {len(scene)} Gaussians can be drawn: all have NaN or infinite values")


def _first(mask: Tensor, count: int) -> Tensor:
    """``mask`` (N,) with only its first ``count`` true entries left true."""
    left = torch.zeros_like(mask)
    left[mask.nonzero()[:count, 0]] = True
    return left
