"""Cutting the bands of spherical harmonics (SH), and the energy that is lost by it.

The basis is orthonormal on the sphere: the mean square, over all directions, of a coefficient's
contribution to a colour is its square divided by 4 pi. So the energy lost is known without
rendering. The visible error is not, as a scene is seen from some directions only: it was up to 9 dB
away from the energy's prediction.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F

from pointsplat_ns.pruning.baselines import log_area
from pointsplat_ns.scene.gaussians import Gaussians


def band_energies(scene: Gaussians) -> list[float]:
    """Mean square of what each SH band adds to the colours: one number for each degree from 1 to
    the scene's.

    The mean is over all directions, over the channels, and over the Gaussians weighted by alpha
    times area. Gaussians that cannot be drawn are left out; the clamping of colours at 0 is
    ignored.
    """
    weights = F.logsigmoid(scene.opacities[:, 0].double()) + log_area(scene)
    drawn = scene.usable() & (weights > -math.inf)
    if not bool(drawn.any()):
        return [0.0] * scene.sh_degree
    weights = torch.softmax(weights[drawn], dim=0)
    squares = (
        weights @ scene.features_rest[drawn].double().square().mean(dim=2) / (4 * math.pi)
    )  # (K,)
    return [
        float(squares[d * d - 1 : (d + 1) ** 2 - 1].sum()) for d in range(1, scene.sh_degree + 1)
    ]


def energy_lost(scene: Gaussians, degree: int) -> float:
    """Share of the view-dependent energy (:func:`band_energies`) that is lost if a scene is cut to
    an SH degree, in [0, 1]; 0 if there is none to lose."""
    energies = band_energies(scene)
    total = sum(energies)
    return sum(energies[degree:]) / total if total > 0 else 0.0


def cut_sh(scene: Gaussians, degree: int) -> Gaussians:
    """The scene without SH bands above ``degree``; all other values are unchanged."""
    return scene.replace(features_rest=scene.features_rest[:, : (degree + 1) ** 2 - 1])
