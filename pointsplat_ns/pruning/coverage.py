"""A score that balances what a Gaussian contributes with what its surroundings would be left with.

A score over all of a scene empties the regions whose Gaussians are small or faint: each of them is worth
little, together they are a wall. Here Gaussians compete with their neighbours alone. Neighbourhoods are
runs of a few Gaussians along a space-filling curve, so that they are small where the scene is dense and
large where it is sparse, and every one keeps the same share of its own mass: no region is emptied.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.morton import interleave, spread_bits
from pointsplat_ns.pruning.scores import log_area

RUN = 12
"""Gaussians of a neighbourhood. Measured on three scenes from 8 to 512: fewer are better at 50 % and worse at 10 %,
where a run has then no Gaussian of its own to keep; 12 to 32 differ little."""

OFFSETS = (0.0, 0.137, -0.0713, 0.0529, -0.1811)
"""The curve is laid five times, its cells moved by these shares of the grid, and the shares averaged, so that the
borders of one curve's runs lie within another's: at 50 % a dB more than with one curve on two of three scenes, nothing
on the third. Nothing about the numbers but that they are no simple fractions."""

AREA_EXPONENT = 0.5
"""Mass is alpha times area to this power: the geometric mean of the two axes that are seen. Area itself (1) keeps blobs
and loses detail; 0.25 to 0.65 differ little."""

_BITS = 20
"""Bits of the grid an axis: 60 of the 63 in a key."""

_RUNS_AT_ONCE = 2**12
"""Runs worked on together: what they need then stays in the cache."""

_SAMPLE = 2**14
"""Positions from which the extent is found, evenly spread over the order of the scene."""


def coverage_score(scene: Gaussians) -> Tensor:
    """Share of the mass of its neighbourhood that a Gaussian and its lesser neighbours make up, (N,) float64 in (0, 1].

    In a neighbourhood of masses m_1 >= m_2 >= ... the i-th scores ``1 - (m_1 + ... + m_(i-1)) / (m_1 + ...)``:
    a threshold keeps in each the fewest Gaussians that hold a given share of its mass, and the best of
    each scores 1 before any other. The score is the mean over five ways to cut the scene into
    neighbourhoods of twelve.

    Args:
        scene: N Gaussians.

    Returns:
        Scores (N,), float64; NaN for Gaussians that cannot be drawn.
    """
    usable = scene.usable()
    whole = bool(usable.all())
    part = scene if whole else scene[usable]
    if len(part) == 0:
        return torch.full_like(usable, math.nan, dtype=torch.float64)
    mass = F.logsigmoid(part.opacities[:, 0].double()) + AREA_EXPONENT * log_area(part)
    mass = mass.float()  # logarithms: seven digits of them are enough to compare neighbours by, and half to move
    cells = unit_cells(part.means)
    scores = torch.zeros_like(mass)
    for i, offset in enumerate(OFFSETS):
        order = curve_keys(cells, offset).argsort(stable=True)
        first = i * RUN // len(OFFSETS)  # where the first whole run begins
        scores.index_add_(0, order, mass_shares(mass[order], RUN, first))
    scores = scores.double() / len(OFFSETS)
    return scores if whole else torch.full_like(usable, math.nan, dtype=torch.float64).masked_scatter_(usable, scores)


def unit_cells(means: Tensor) -> Tensor:
    """Positions (N, 3) in a cube of side 1/2 about 1/2 that holds most of them; float32, those far out clamped to
    [0, 1]. A few Gaussians far away, which nearly every scene has, do not coarsen the grid of the others."""
    some = means[:: max(1, len(means) // _SAMPLE)].double()
    n = len(some)
    ranked = some.sort(dim=0).values
    low, high = ranked[(n - 1) // 100], ranked[n - 1 - (n - 1) // 100]
    side = 2 * (high - low).amax()
    cells = (means.double() - 0.5 * (low + high)).div_(side.clamp_min(torch.finfo(torch.float64).tiny))
    return cells.float().clamp_(-0.5, 0.5).add_(0.5)


def curve_keys(cells: Tensor, offset: float = 0.0) -> Tensor:
    """Places (N,) int64 on the Morton curve of points (N, 3) in the unit cube, after a move by ``offset``."""
    grid = (cells.T + offset).clamp_(0, 1).mul_(2**_BITS - 1).long()
    return interleave(*(spread_bits(axis) for axis in grid))


def mass_shares(log_mass: Tensor, run: int, first: int = 0) -> Tensor:
    """For each item of a sequence, the share of the mass of its run that it and the lesser items of it make up.

    Of two equal items the earlier counts as the greater.

    Args:
        log_mass: (N,) logarithms of the masses; -Inf is no mass.
        run: items of a run.
        first: where the first whole run begins; what is before is a run of its own, and so is what is left at the end.

    Returns:
        (N,) in [0, 1]; 0 for items without mass, but in a run that has none at all they count as equal.
    """
    n, before = len(log_mass), -first % run
    padded = F.pad(log_mass, (before, -(n + before) % run), value=math.nan).view(-1, run)
    parts = [_shares_of_runs(part.T) for part in padded.split(_RUNS_AT_ONCE)]
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
