"""Cuts spherical harmonics (SH) bands, and computes the energy lost.

The basis is orthonormal on the sphere: the mean square, over all directions, of a coefficient's
contribution to a colour is its square divided by 4 pi. So the lost energy needs no rendering. It
does not predict the visible error, because a scene is seen from some directions only: PSNR differed
by up to 9 dB.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F

from pointsplat_ns.pruning.baselines import log_area
from pointsplat_ns.scene.gaussians import Gaussians


def band_energies(scene: Gaussians) -> list[float]:
    """Mean square of each SH band's contribution to the colours: one number per degree from 1 to
    the scene's.

    The mean is over all directions, over the channels, and over the Gaussians weighted by alpha
    times area. Gaussians that cannot be drawn are excluded; the clamping of colours at 0 is
    ignored.
    """
    weights = F.logsigmoid(scene.opacities[:, 0].double()) + log_area(scene)
    drawn = scene.usable() & (weights > -math.inf)
    if not bool(drawn.any()):
        return [0.0] * scene.sh_degree
    weights = torch.softmax(weights[drawn], dim=0)
    # (K,)
    squares = weights @ scene.features_rest[drawn].double().square().mean(dim=2) / (4 * math.pi)
    return [
        float(squares[d * d - 1 : (d + 1) ** 2 - 1].sum()) for d in range(1, scene.sh_degree + 1)
    ]


def energy_lost(scene: Gaussians, degree: int) -> float:
    """Share of the view-dependent energy (:func:`band_energies`) lost by cutting a scene to an SH
    degree, in [0, 1]; 0 if there is no such energy."""
    energies = band_energies(scene)
    total = sum(energies)
    return sum(energies[degree:]) / total if total > 0 else 0.0


def cut_sh(scene: Gaussians, degree: int) -> Gaussians:
    """The scene without SH bands above ``degree``; all other values are unchanged."""
    return scene.replace(features_rest=scene.features_rest[:, : (degree + 1) ** 2 - 1])
