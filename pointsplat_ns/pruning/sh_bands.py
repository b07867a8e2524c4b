"""Spherical harmonics that a scene does not need.

The basis is orthonormal on the sphere: the mean square, over all directions, of what a coefficient adds to
a colour is its square divided by 4 pi, and leaving coefficients out is the best that can be done with
those that stay. So the energy lost is known without rendering. How much of it is seen is not: a scene
is seen from some directions only, and real ones were measured up to 9 dB away from what the energy
predicts. Which degree to keep is therefore decided by rendering, outside this package.
"""

from __future__ import annotations

import math

import torch

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.pruning.scores import area_score


def band_energies(scene: Gaussians) -> list[float]:
    """Mean square of what each SH band adds to the colours: one number for each degree from 1 to the scene's.

    The mean is over all directions, over the channels, and over the Gaussians weighted by alpha times area.
    Gaussians that cannot be drawn take no part; the clamp of colours at black is not taken into account.
    """
    weights = area_score(scene)
    seen = weights > -math.inf  # NaN fails too
    if not bool(seen.any()):
        return [0.0] * scene.sh_degree
    weights = torch.softmax(weights[seen], dim=0)
    squares = weights @ scene.features_rest[seen].double().square().mean(dim=2) / (4 * math.pi)  # (K,)
    return [float(squares[d * d - 1 : (d + 1) ** 2 - 1].sum()) for d in range(1, scene.sh_degree + 1)]


def energy_lost(scene: Gaussians, degree: int) -> float:
    """Share of the change of colour with the direction that is lost when a scene is cut to an SH degree.

    Returns:
        In [0, 1]; 0 where there is nothing to lose.

    Raises:
        BudgetError: if the degree is not 0 to 3.
    """
    _check(degree)
    energies = band_energies(scene)
    total = sum(energies)
    return sum(energies[degree:]) / total if total > 0 else 0.0


def cut_sh(scene: Gaussians, degree: int) -> Gaussians:
    """The scene without SH bands above ``degree``; what stays is bit for bit as it was.

    Raises:
        BudgetError: if the degree is not 0 to 3.
    """
    _check(degree)
    return scene.replace(features_rest=scene.features_rest[:, : (degree + 1) ** 2 - 1])


def _check(degree: int) -> None:
    if not 0 <= degree <= MAX_SH_DEGREE:
        raise BudgetError(f"SH degree is {degree}; expected 0 to {MAX_SH_DEGREE}")
