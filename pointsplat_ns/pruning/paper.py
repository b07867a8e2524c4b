"""The paper's pruning ("Geometry-Driven Pruning Score", eq. 3): a score of opacity and volume.

A score is a function of the scene and returns (N,) float64 on the scene's device; the highest are
kept. Gaussians that cannot be drawn score NaN and are excluded from the statistics of the others.
Scores are computed from logarithms and logits in float64, so that nothing overflows.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError, PointSplatError
from pointsplat_ns.scene.gaussians import Gaussians

DEFAULT_OPACITY_WEIGHT = 0.3
"""Lambda of eq. 3; the paper uses one value for all data sets."""


class ScoreError(PointSplatError, ValueError):
    """An invalid option of a score."""


def paper_score(scene: Gaussians, opacity_weight: float = DEFAULT_OPACITY_WEIGHT) -> Tensor:
    """The paper's score: weighted z-scores of opacity and volume.

    Eq. 3: ``opacity_weight * z(alpha) + (1 - opacity_weight) * z(4/3 pi sx sy sz)``, with z-scores
    over the scene.

    Args:
        scene: N Gaussians.
        opacity_weight: lambda, in [0, 1].

    Returns:
        Scores (N,), float64.

    Raises:
        ScoreError: if ``opacity_weight`` is not in [0, 1].

    Example:
        >>> import pointsplat_ns as ps
        >>> scene = ps.example_room()
        >>> pruned = scene[ps.select(ps.paper_score(scene), 1000)]
        >>> pruned.means.equal(ps.prune(scene, keep=1000, by="paper").means)
        True
    """
    return weighted_score(
        scene,
        opacity_weight,
        lambda part: part.opacities[:, 0].double().sigmoid(),
        _relative_volume,
    )


def weighted_score(
    scene: Gaussians,
    opacity_weight: float,
    opacity_of: Callable[[Gaussians], Tensor],
    size_of: Callable[[Gaussians], Tensor],
) -> Tensor:
    """Eq. 3 for any opacity and size, each (N,); arguments and errors as :func:`paper_score`."""
    if not 0 <= opacity_weight <= 1:  # NaN fails too
        raise ScoreError(f"opacity_weight is {opacity_weight}; expected 0 to 1")
    return of_usable(
        scene,
        lambda part: (
            opacity_weight * zscore(opacity_of(part)) + (1 - opacity_weight) * zscore(size_of(part))
        ),
    )


def zscore(values: Tensor) -> Tensor:
    """The paper's nu: ``(values - mean) / std`` in float64, (N,); zero if all values are the same.

    The standard deviation divides by N; N - 1 would scale all scores alike and not change the
    ranking.
    """
    values = values.double()
    if values.numel() == 0 or values.max() == values.min():
        return torch.zeros_like(values)
    centred = values - values.mean()
    return centred / centred.square().mean().sqrt()


def log_volume(scene: Gaussians) -> Tensor:
    """Natural logarithm of 4/3 pi sx sy sz, cubic scene units, (N,) float64; -Inf if flat."""
    return scene.scales.double().sum(dim=1) + math.log(4 / 3 * math.pi)


def _relative_volume(scene: Gaussians) -> Tensor:
    """Volumes relative to the largest, in [0, 1], (N,) float64: they have the z-scores of the
    volumes, without overflow."""
    logs = log_volume(scene)
    largest = logs.max() if len(scene) else -math.inf
    return torch.exp(logs - largest) if largest > -math.inf else torch.zeros_like(logs)


def of_usable(scene: Gaussians, score: Callable[[Gaussians], Tensor]) -> Tensor:
    """A score of the Gaussians that can be drawn, NaN for the others, (N,) float64."""
    usable = scene.usable()
    if bool(usable.all()):
        return score(scene)
    return torch.full_like(usable, math.nan, dtype=torch.float64).masked_scatter_(
        usable, score(scene[usable])
    )


def select(scores: Tensor, k: int) -> Tensor:
    """Select the Gaussians with the highest scores.

    Of equal scores, lower indices come first; NaN ranks below every number.

    Args:
        scores: (N,), of any floating type, +-Inf allowed.
        k: number of Gaussians to keep.

    Returns:
        Indices (k,), int64, ascending.

    Raises:
        BudgetError: if ``k`` is not in 0..N.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.select(torch.tensor([0.5, 2.0, 1.0]), 2)
        tensor([1, 2])
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
    """``mask`` (N,) reduced to its first ``count`` true entries."""
    left = torch.zeros_like(mask)
    left[mask.nonzero()[:count, 0]] = True
    return left
