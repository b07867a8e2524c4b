"""Scores of Gaussians by their own attributes: the higher, the more worth keeping.

Every score is a function of the scene, with options of its own, and returns (N,) float64 on the scene's device.
Gaussians that cannot be drawn score NaN and are left out of the statistics of the others. Scores are computed from
logarithms and logits in float64, so that nothing overflows.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.system.tensors import DOUBLES

DEFAULT_OPACITY_WEIGHT = 0.3
"""Lambda of the paper's eq. 3, which uses the same value for every data set."""


class ScoreError(PointSplatError, ValueError):
    """An option that a score cannot work with."""


def zscore(values: Tensor) -> Tensor:
    """``(values - mean) / std`` in float64, (N,); zero if all values are the same.

    The standard deviation divides by N; N - 1 would scale all scores alike and change no ranking.
    """
    values = values.double()
    if values.numel() == 0 or values.max() == values.min():
        return torch.zeros_like(values)
    centred = values - values.mean()
    return centred / centred.square().mean().sqrt()


def log_volume(scene: Gaussians) -> Tensor:
    """Natural logarithm of 4/3 pi sx sy sz, cubic scene units, (N,) float64; -Inf for a flat Gaussian."""
    return scene.scales.double().sum(dim=1) + math.log(4 / 3 * math.pi)


def paper_score(scene: Gaussians, opacity_weight: float = DEFAULT_OPACITY_WEIGHT) -> Tensor:
    """The paper's geometry-driven score (eq. 3).

    ``opacity_weight * z(alpha) + (1 - opacity_weight) * z(4/3 pi sx sy sz)``, with z-scores over the
    scene. A z-score does not change when all its values are multiplied by one factor, so volumes are
    taken relative to the largest: nothing overflows, whatever the log-scales.

    Args:
        scene: N Gaussians.
        opacity_weight: lambda, in [0, 1].

    Returns:
        Scores (N,), float64.

    Raises:
        ScoreError: if ``opacity_weight`` is not in [0, 1].
    """
    return _weighted(scene, opacity_weight, lambda part: torch.sigmoid(part.opacities[:, 0].double()), _volumes)


def authors_score(scene: Gaussians, opacity_weight: float = DEFAULT_OPACITY_WEIGHT) -> Tensor:
    """The score of the paper's released code, which differs from eq. 3.

    ``opacity_weight * z(logit) + (1 - opacity_weight) * z(4/3 pi product of (log-scale + 1e-6))``: the raw
    logit in place of alpha, and a product of logarithms in place of the volume. Infinite values are replaced by the
    largest (smallest) finite one, so that mean and deviation stay finite.

    Raises:
        ScoreError: if ``opacity_weight`` is not in [0, 1].
    """
    return _weighted(
        scene,
        opacity_weight,
        lambda part: _within_finite(part.opacities[:, 0].double()),
        lambda part: 4 / 3 * math.pi * (_within_finite(part.scales.double()) + 1e-6).prod(dim=1),
    )


def log_volume_score(scene: Gaussians, opacity_weight: float = DEFAULT_OPACITY_WEIGHT) -> Tensor:
    """Eq. 3 with the logarithm of the volume in place of the volume, so that a few giants do not dominate the z-score.

    ``opacity_weight * z(alpha) + (1 - opacity_weight) * z(log(4/3 pi sx sy sz))``.

    Raises:
        ScoreError: if ``opacity_weight`` is not in [0, 1].
    """
    return _weighted(
        scene,
        opacity_weight,
        lambda part: torch.sigmoid(part.opacities[:, 0].double()),
        lambda part: _within_finite(log_volume(part)),
    )


def opacity_score(scene: Gaussians) -> Tensor:
    """Opacity alone: the logit, which ranks like alpha but does not saturate, (N,) float64."""
    return _only_usable(scene, scene.opacities[:, 0].double())


def volume_score(scene: Gaussians) -> Tensor:
    """Volume alone: its logarithm, which ranks like the volume but does not overflow, (N,) float64."""
    return _only_usable(scene, log_volume(scene))


def log_area(scene: Gaussians) -> Tensor:
    """Natural logarithm of the product of the two largest standard deviations, squared scene units, (N,) float64. Up to
    a factor, this is the area seen from the broad side."""
    scales = scene.scales.double()
    return scales.sum(dim=1) - scales.amin(dim=1) if bool(scales.isfinite().all()) else scales.topk(2).values.sum(1)


def area_score(scene: Gaussians) -> Tensor:
    """Opacity times area: log(alpha * product of the two largest standard deviations), (N,) float64."""
    return _only_usable(scene, F.logsigmoid(scene.opacities[:, 0].double()) + log_area(scene))


def random_score(scene: Gaussians, seed: int = 0) -> Tensor:
    """Uniform in [0, 1), the same for a seed on every device, (N,) float64: a baseline."""
    generator = torch.Generator().manual_seed(seed)
    return _only_usable(scene, torch.rand(len(scene), generator=generator, **DOUBLES).to(scene.device))


def _only_usable(scene: Gaussians, scores: Tensor) -> Tensor:
    return torch.where(scene.usable(), scores, math.nan)


def _weighted(
    scene: Gaussians,
    opacity_weight: float,
    opacity_of: Callable[[Gaussians], Tensor],
    size_of: Callable[[Gaussians], Tensor],
) -> Tensor:
    """The weighted sum of the z-scores of an opacity and a size, over the Gaussians that can be drawn."""
    if not 0 <= opacity_weight <= 1:  # NaN fails too
        raise ScoreError(f"opacity_weight is {opacity_weight}; expected 0 to 1")
    usable = scene.usable()
    whole = bool(usable.all())
    part = scene if whole else scene[usable]
    scores = opacity_weight * zscore(opacity_of(part)) + (1 - opacity_weight) * zscore(size_of(part))
    return scores if whole else torch.full_like(usable, math.nan, dtype=torch.float64).masked_scatter_(usable, scores)


def _volumes(scene: Gaussians) -> Tensor:
    """Volumes relative to the largest, in [0, 1], (N,) float64."""
    logs = log_volume(scene)
    largest = logs.max() if len(scene) else -math.inf
    return torch.exp(logs - largest) if largest > -math.inf else torch.zeros_like(logs)


def _within_finite(values: Tensor) -> Tensor:
    """``values`` with infinite ones replaced by the largest (smallest) finite one, or by +-1 if none is finite."""
    finite = values[values.isfinite()]
    if len(finite) == values.numel():
        return values
    return values.clamp(*finite.aminmax()) if len(finite) else values.clamp(-1.0, 1.0)
