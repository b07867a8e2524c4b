"""Baseline scores from the attributes of Gaussians.

The paper's score is in :mod:`~pointsplat_ns.pruning.paper`.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.geometry.transforms import curve_keys, unit_cells
from pointsplat_ns.pruning.paper import DEFAULT_OPACITY_WEIGHT, of_usable, weighted_score
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.tensors import DOUBLES


def authors_score(scene: Gaussians, opacity_weight: float = DEFAULT_OPACITY_WEIGHT) -> Tensor:
    """The score of the paper's released code, which differs from eq. 3.

    ``opacity_weight * z(logit) + (1 - opacity_weight) * z(4/3 pi product of (log-scale + 1e-6))``:
    the raw logit in place of alpha, and a product of logarithms in place of the volume. Infinite
    values become the largest (smallest) finite one, so that mean and deviation stay finite. Errors
    as of :func:`~pointsplat_ns.pruning.paper.paper_score`.
    """
    return weighted_score(
        scene,
        opacity_weight,
        lambda part: _within_finite(part.opacities[:, 0].double()),
        lambda part: 4 / 3 * math.pi * (_within_finite(part.scales.double()) + 1e-6).prod(dim=1),
    )


def opacity_score(scene: Gaussians) -> Tensor:
    """Opacity logit, (N,) float64; ranks like alpha but does not saturate."""
    return of_usable(scene, lambda part: part.opacities[:, 0].double())


def log_area(scene: Gaussians) -> Tensor:
    """Natural logarithm of the product of the two largest standard deviations, squared scene units,
    (N,) float64: up to a factor, the projected area of the broad side."""
    scales = scene.scales.double()
    return (
        scales.sum(dim=1) - scales.amin(dim=1)
        if bool(scales.isfinite().all())
        else scales.topk(2).values.sum(1)
    )


def random_score(scene: Gaussians) -> Tensor:
    """Uniform in [0, 1), (N,) float64; the same on every device."""
    generator = torch.Generator().manual_seed(0)
    scores = torch.rand(len(scene), generator=generator, **DOUBLES).to(scene.device)
    return torch.where(scene.usable(), scores, math.nan)


def _within_finite(values: Tensor) -> Tensor:
    """``values`` with infinite ones replaced by the largest (smallest) finite one, or by +-1 if
    none is finite."""
    finite = values[values.isfinite()]
    if len(finite) == values.numel():
        return values
    return values.clamp(*finite.aminmax()) if len(finite) else values.clamp(-1.0, 1.0)


def coverage_score(scene: Gaussians) -> Tensor:
    """Share of a neighbourhood's mass in a Gaussian and its neighbours of less mass, (N,) float64
    in (0, 1]; NaN for Gaussians that cannot be drawn.

    A score over the whole scene empties regions whose Gaussians are small or faint, even if many of
    them together form a surface. Here Gaussians compete only with their neighbours, a short run
    along a space-filling curve: small in dense regions, large in sparse ones.

    In a neighbourhood of masses m_1 >= m_2 >= ... the i-th scores ``1 - (m_1 + ... + m_(i-1)) /
    (m_1 + ...)``. So a threshold keeps, in each neighbourhood, the fewest Gaussians with a given
    share of its mass; the largest scores 1. The score is the mean over five divisions of the scene
    into neighbourhoods of twelve.
    """
    return of_usable(scene, _shares_of_neighbourhoods)


def _shares_of_neighbourhoods(scene: Gaussians) -> Tensor:
    if len(scene) == 0:
        return scene.means.new_zeros(0, dtype=torch.float64)
    # Measured on three scenes with 8 to 512 Gaussians per neighbourhood: fewer are better if 50 %
    # are kept, and worse at 10 %, where some runs then keep no Gaussian; 12 to 32 differ little.
    run = 12

    # Each curve is shifted by one of these shares of the grid, so that runs have other borders. At
    # 50 % this gains one dB over a single curve on two of three scenes, and nothing on the third.
    # The numbers are arbitrary, but not simple fractions.
    offsets = (0.0, 0.137, -0.0713, 0.0529, -0.1811)

    # The square root of the area is the geometric mean of the two largest axes. The area itself
    # keeps blobs and loses detail; powers of 0.25 to 0.65 differ little.
    mass = F.logsigmoid(scene.opacities[:, 0].double()) + 0.5 * log_area(scene)
    mass = mass.float()  # precise enough to compare log-masses, in half the memory
    cells = unit_cells(scene.means)
    scores = torch.zeros_like(mass)
    for i, offset in enumerate(offsets):
        order = curve_keys(cells, offset).argsort(stable=True)
        first = i * run // len(offsets)  # start of the first whole run
        scores.index_add_(0, order, mass_shares(mass[order], run, first))
    return scores.double() / len(offsets)


def mass_shares(log_mass: Tensor, run: int, first: int) -> Tensor:
    """Share of a run's mass in each item and the run's smaller items, for a sequence of items.

    Of two equal items, the earlier counts as the larger.

    Args:
        log_mass: (N,) logarithms of the masses, N at least 1; -Inf is no mass.
        run: number of items in a run.
        first: start of the first whole run; the items before it form a run, and so do those left at
            the end.

    Returns:
        (N,) in [0, 1]; 0 for items without mass. In a run without any mass, all items are equal.
    """
    n = len(log_mass)
    before = -first % run
    padded = F.pad(log_mass, (before, -(n + before) % run), value=math.nan).view(-1, run)
    found = []
    for part in padded.split(2**12):  # fits the processor's cache
        logs = part.T  # (run, R), NaN for padding
        missing = logs.isnan()
        logs = logs.nan_to_num(nan=-math.inf)
        largest = logs.amax(dim=0)
        empty = largest == -math.inf
        mass = (logs - largest.masked_fill(empty, 0.0)).exp().contiguous()
        mass += (empty & ~missing).to(mass)  # a run without mass: its items are equal
        shares = torch.zeros_like(mass)
        for i, item in enumerate(mass):
            shares[: i + 1].addcmul_(item <= mass[: i + 1], item)
            shares[i + 1 :].addcmul_(item < mass[i + 1 :], item)
        found.append(
            (shares / shares.amax(dim=0).clamp_min(torch.finfo(mass.dtype).tiny)).T.reshape(-1)
        )
    return torch.cat(found)[before : before + n]
