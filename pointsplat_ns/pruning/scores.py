"""Scores of Gaussians: the higher, the more worth keeping.

Every score is a function of the scene and options of its own, and gives (N,) float64 on the scene's
device. Gaussians that cannot be drawn score NaN and take no part in the statistics of the others.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians

DEFAULT_OPACITY_WEIGHT = 0.3
"""Lambda of the paper's eq. 3, the same for every data set."""


class ScoreError(PointSplatError, ValueError):
    """An option that a score cannot work with."""


def zscore(values: Tensor) -> Tensor:
    """``(values - mean) / std`` in float64, (N,); zero where all values are the same.

    The standard deviation is that of the N values themselves (divided by N); N - 1 would scale all
    scores alike and change no ranking.
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
    if not 0 <= opacity_weight <= 1:
        raise ScoreError(f"opacity_weight is {opacity_weight}; expected 0 to 1")
    usable = scene.usable()
    scores = torch.full((len(scene),), math.nan, dtype=torch.float64, device=scene.device)
    part = scene if bool(usable.all()) else scene[usable]
    if len(part) == 0:
        return scores
    alphas = torch.sigmoid(part.opacities[:, 0].double())
    logs = log_volume(part)
    largest = logs.max()
    volumes = torch.exp(logs - largest) if largest > -math.inf else torch.zeros_like(logs)
    scores[usable] = opacity_weight * zscore(alphas) + (1 - opacity_weight) * zscore(volumes)
    return scores


def opacity_score(scene: Gaussians) -> Tensor:
    """Opacity alone: the logit, which ranks as alpha does and does not saturate, (N,) float64."""
    return _only_usable(scene, scene.opacities[:, 0].double())


def volume_score(scene: Gaussians) -> Tensor:
    """Volume alone: its logarithm, which ranks as the volume does and does not overflow, (N,) float64."""
    return _only_usable(scene, log_volume(scene))


def random_score(scene: Gaussians, seed: int = 0) -> Tensor:
    """Uniform in [0, 1), the same for one seed on every device, (N,) float64: the baseline to beat."""
    generator = torch.Generator().manual_seed(seed)
    return _only_usable(scene, torch.rand(len(scene), generator=generator, dtype=torch.float64).to(scene.device))


def _only_usable(scene: Gaussians, scores: Tensor) -> Tensor:
    return torch.where(scene.usable(), scores, math.nan)


SCORES: dict[str, Callable[..., Tensor]] = {
    "paper": paper_score,
    "opacity": opacity_score,
    "volume": volume_score,
    "random": random_score,
}
"""Scores by name; each takes the scene and keyword options of its own."""
