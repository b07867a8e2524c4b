"""Scores of Gaussians by their own attributes, to compare with the paper's (:mod:`~pointsplat_ns.pruning.paper`)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning.paper import DEFAULT_OPACITY_WEIGHT, of_usable, weighted_score
from pointsplat_ns.system.tensors import DOUBLES


def authors_score(scene: Gaussians, opacity_weight: float = DEFAULT_OPACITY_WEIGHT) -> Tensor:
    """The score of the paper's released code, which differs from eq. 3.

    ``opacity_weight * z(logit) + (1 - opacity_weight) * z(4/3 pi product of (log-scale + 1e-6))``: the raw
    logit in place of alpha, and a product of logarithms in place of the volume. Infinite values are replaced by the
    largest (smallest) finite one, so that mean and deviation stay finite. Errors as of
    :func:`~pointsplat_ns.pruning.paper.paper_score`.
    """
    return weighted_score(
        scene,
        opacity_weight,
        lambda part: _within_finite(part.opacities[:, 0].double()),
        lambda part: 4 / 3 * math.pi * (_within_finite(part.scales.double()) + 1e-6).prod(dim=1),
    )


def opacity_score(scene: Gaussians) -> Tensor:
    """Opacity alone: the logit, which ranks like alpha but does not saturate, (N,) float64."""
    return of_usable(scene, lambda part: part.opacities[:, 0].double())


def log_area(scene: Gaussians) -> Tensor:
    """Natural logarithm of the product of the two largest standard deviations, squared scene units, (N,) float64. Up to
    a factor, this is the area seen from the broad side."""
    scales = scene.scales.double()
    return scales.sum(dim=1) - scales.amin(dim=1) if bool(scales.isfinite().all()) else scales.topk(2).values.sum(1)


def random_score(scene: Gaussians, seed: int = 0) -> Tensor:
    """Uniform in [0, 1), the same for a seed on every device, (N,) float64."""
    generator = torch.Generator().manual_seed(seed)
    scores = torch.rand(len(scene), generator=generator, **DOUBLES).to(scene.device)
    return torch.where(scene.usable(), scores, math.nan)


def _within_finite(values: Tensor) -> Tensor:
    """``values`` with infinite ones replaced by the largest (smallest) finite one, or by +-1 if none is finite."""
    finite = values[values.isfinite()]
    if len(finite) == values.numel():
        return values
    return values.clamp(*finite.aminmax()) if len(finite) else values.clamp(-1.0, 1.0)
