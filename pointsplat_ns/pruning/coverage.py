"""A score that keeps the same share of mass in every neighbourhood of a scene.

A score over the whole scene empties regions whose Gaussians are small or faint, even if many of them together form a
surface. Here Gaussians compete only with their neighbours. A neighbourhood is a run of a few Gaussians along a
space-filling curve: small where the scene is dense, large where it is sparse. Each neighbourhood keeps the same share
of its mass, so no region is emptied.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import curve_keys, unit_cells
from pointsplat_ns.pruning.baselines import log_area
from pointsplat_ns.pruning.paper import of_usable


def coverage_score(scene: Gaussians) -> Tensor:
    """Share of a neighbourhood's mass held by a Gaussian and its neighbours of less mass, (N,) float64 in (0, 1].

    In a neighbourhood of masses m_1 >= m_2 >= ... the i-th scores ``1 - (m_1 + ... + m_(i-1)) / (m_1 + ...)``. So a
    threshold keeps, in each neighbourhood, the fewest Gaussians that hold a given share of its mass; the largest scores
    1. The score is the mean over five ways to divide the scene into neighbourhoods of twelve.

    Args:
        scene: N Gaussians.

    Returns:
        Scores (N,), float64; NaN for Gaussians that cannot be drawn.
    """
    return of_usable(scene, _shares_of_neighbourhoods)


def _shares_of_neighbourhoods(scene: Gaussians) -> Tensor:
    if len(scene) == 0:
        return scene.means.new_zeros(0, dtype=torch.float64)
    # Measured on three scenes from 8 to 512 in a neighbourhood: fewer are better when 50 % are kept, and worse at 10 %,
    # where some runs then keep no Gaussian; 12 to 32 differ little.
    run = 12

    # Each curve is shifted by one of these shares of the grid, so that runs have other borders. At 50 % this gains one
    # dB over a single curve on two of three scenes, and nothing on the third. The numbers are arbitrary, but not simple
    # fractions.
    offsets = (0.0, 0.137, -0.0713, 0.0529, -0.1811)

    # The root of the area is the geometric mean of the two largest axes. Area itself keeps blobs and loses detail;
    # powers of 0.25 to 0.65 differ little.
    mass = F.logsigmoid(scene.opacities[:, 0].double()) + 0.5 * log_area(scene)
    mass = mass.float()  # float32 is enough to compare logarithms of masses, and half the memory
    cells = unit_cells(scene.means)
    scores = torch.zeros_like(mass)
    for i, offset in enumerate(offsets):
        order = curve_keys(cells, offset).argsort(stable=True)
        first = i * run // len(offsets)  # where the first whole run begins
        scores.index_add_(0, order, mass_shares(mass[order], run, first))
    return scores.double() / len(offsets)


def mass_shares(log_mass: Tensor, run: int, first: int = 0) -> Tensor:
    """For each item of a sequence, the share of its run's mass that it and the run's smaller items hold.

    Of two equal items the earlier counts as the larger.

    Args:
        log_mass: (N,) logarithms of the masses; -Inf is no mass.
        run: number of items in a run.
        first: where the first whole run begins; the items before it form a run, and so do those left at the end.

    Returns:
        (N,) in [0, 1]; 0 for items without mass. In a run without any mass, all items count as equal.
    """
    n, before = len(log_mass), -first % run
    padded = F.pad(log_mass, (before, -(n + before) % run), value=math.nan).view(-1, run)
    parts = [_shares_of_runs(part.T) for part in padded.split(2**12)]  # fits the processor's cache
    return torch.cat(parts)[before : before + n] if parts else log_mass


def _shares_of_runs(log_mass: Tensor) -> Tensor:
    """Shares of whole runs (run, R), NaN where there is no item, as (R * run,)."""
    missing = log_mass.isnan()
    log_mass = log_mass.nan_to_num(nan=-math.inf)
    largest = log_mass.amax(dim=0)
    empty = largest == -math.inf
    mass = (log_mass - largest.masked_fill(empty, 0.0)).exp().contiguous()
    mass += (empty & ~missing).to(mass)  # a run without mass: its items count as equal
    shares = torch.zeros_like(mass)
    for i, item in enumerate(mass):
        shares[: i + 1].addcmul_(item <= mass[: i + 1], item)
        shares[i + 1 :].addcmul_(item < mass[i + 1 :], item)
    return (shares / shares.amax(dim=0).clamp_min(torch.finfo(mass.dtype).tiny)).T.reshape(-1)
