"""Rounds the numbers of a scene before a format compresses them, where the error is least visible.

Multiples of a larger step take fewer bits in a compressed file. Rounding to steps D has a root mean
squared error of D / sqrt(12). The steps of a Gaussian follow from its tolerance t, an error of its
colour:

- SH coefficients change the colour by SH_C0 times their error, the rms of every basis function over
  all directions.
- Other numbers change the Gaussian's shape. The L2 norm of the change, relative to that of the
  Gaussian, is d / (sqrt(2) s) for a shift by d along an axis of standard deviation s, sqrt(3/4) d
  for a log-scale, and |a / b - b / a| d for a component of its quaternion, in the plane of two axes
  a and b. The colour changes by this norm times the contrast of the Gaussian with its surroundings.

A Gaussian covers about alpha s1 s2 of an image's area, with s1 and s2 its largest standard
deviations. The squared error of an image is least, for a given number of bits, if every Gaussian
contributes equally, so t is proportional to (alpha s1 s2)^(-1/2). Small Gaussians are often seen
from nearer, so the square root of the area is used instead.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.formats.coding import from_smallest_three, smallest_three, unit_quats
from pointsplat_ns.scene.gaussians import Gaussians


@dataclass(frozen=True)
class RoundingSettings:
    """Amount of rounding. ``python -m lab.judge.bytes`` evaluates all fields together."""

    share: float = 0.55
    """Tolerance relative to the error that a scene already has, by its PSNR."""
    share_without_sh: float = 0.85
    """The same at SH degree 0, which has no palette: the error of renders is about half of the
    tolerance. Statues at 0.5 MB gain 0.3 to 1.1 dB over 0.55."""
    best_psnr: float = 45.0
    """PSNR assumed for a scene without error, dB."""
    contrast: float = 0.22
    """Contrast of a Gaussian with its surroundings, a share of the colour range."""
    thinnest: float = 0.1
    """Smallest standard deviation of an axis relative to the longest axis; thinner axes are drawn
    thicker."""
    palette_error: float = 2.5
    """Colour error of an SH palette, in tolerances. Finer colours take more bytes than fewer
    Gaussians save."""
    most_rows: int = 32
    """Minimum number of Gaussians per palette entry."""


ROUNDING = RoundingSettings()


def rounding_for(psnr: float, sh_degree: int) -> float:
    """Rounding tolerance of a scene with a PSNR, dB, and SH degree: the colour error of a Gaussian
    of typical weight, as a share of the colour range."""
    share = ROUNDING.share if sh_degree else ROUNDING.share_without_sh
    return share * 10 ** (-min(psnr, ROUNDING.best_psnr) / 20)


class Steps(NamedTuple):
    """Largest rounding steps of N Gaussians, each (N, 1) float64."""

    sh: Tensor
    alphas: Tensor
    log_scales: Tensor
    means: Tensor  # world units
    quats: Tensor  # of unit quaternions


def weights(scene: Gaussians) -> Tensor:
    """Weight (N,) float64 of each Gaussian's squared colour error, up to a common factor."""
    sizes = scene.scales.double().sort(dim=1).values
    logs = scene.alphas.double().clamp_min(1 / 255).log().flatten() + sizes[:, 1] + sizes[:, 2]
    return (0.5 * (logs - logs.mean())).exp() if len(scene) else logs


def steps_of(scene: Gaussians, tolerance: float) -> Steps:
    """Steps of N drawable Gaussians on the CPU; ``tolerance`` is for a Gaussian of typical
    weight."""
    each = (tolerance * weights(scene).rsqrt())[:, None]
    uniform = math.sqrt(12)  # step whose rounding has a root mean squared error of 1
    shape = uniform * each / ROUNDING.contrast
    logs = scene.scales.double().sort(dim=1).values
    ratio = (logs[:, 2:] - logs[:, :1]).clamp(max=-math.log(ROUNDING.thinnest))
    smallest = (logs[:, 2:] - ratio).exp()
    return Steps(
        sh=uniform * each / SH_C0,
        alphas=shape * scene.alphas.double().reshape(-1, 1),
        log_scales=shape / math.sqrt(0.75),
        means=shape * math.sqrt(2) * smallest,
        quats=shape / (2 * ratio.sinh()).clamp_min(1e-3),
    )


def rounded(scene: Gaussians, tolerance: float) -> Gaussians:
    """A scene of N drawable Gaussians, float32 on the CPU, with every number rounded to a multiple
    of the largest power of two that its step allows. ``tolerance``, above 0, is for a Gaussian of
    typical weight."""
    if not len(scene):
        return scene
    steps = steps_of(scene, tolerance)
    return rounded_shapes(scene, steps).replace(
        means=multiples(scene.means.double(), steps.means).float(),
        features_rest=multiples(scene.features_rest.double(), steps.sh[:, None]).float(),
    )


def rounded_shapes(scene: Gaussians, steps: Steps) -> Gaussians:
    """A scene rounded as by :func:`rounded`, except positions and SH above degree 0."""
    largest, parts = smallest_three(unit_quats(scene))
    others = multiples(torch.from_numpy(parts), steps.quats).clamp(-(0.5**0.5), 0.5**0.5)
    alphas = multiples(scene.alphas.double().reshape(-1, 1), steps.alphas).clamp(1 / 255, 254 / 255)
    return scene.replace(
        scales=multiples(scene.scales.double(), steps.log_scales).float(),
        quats=torch.from_numpy(from_smallest_three(largest, others.numpy())),
        opacities=alphas.logit().float().reshape(scene.opacities.shape),
        features_dc=multiples(scene.features_dc.double(), steps.sh).float(),
    )


def multiples(values: Tensor, steps: Tensor) -> Tensor:
    """Values rounded to multiples of the largest power of two within each step (broadcast)."""
    steps = steps.clamp(2.0**-60, 2.0**60).log2().floor().exp2()
    return (values / steps).round() * steps
