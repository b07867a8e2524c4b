"""Rounds the numbers of a scene before a format compresses them, where the error shows least.

A number that is a multiple of a larger step takes fewer bits in a compressed file. Rounding to
steps D has a root mean squared error of D / sqrt(12). The steps of a Gaussian follow from its
tolerance t, an error of its colour:

- SH coefficients change the colour by SH_C0 times their error, the rms of every basis function over
  all directions.
- Other numbers change the Gaussian's shape. The L2 norm of the change, relative to that of the
  Gaussian, is d / (sqrt(2) s) for a shift by d along an axis of standard deviation s, sqrt(3/4) d
  for a log-scale, and
  |a / b - b / a| d for a component of its quaternion, in the plane of two axes a and b. The colour
  changes by that times the contrast of the Gaussian with what is around it.

A Gaussian is seen in about alpha s1 s2 of a picture's area, with s1 and s2 its largest standard
deviations. Where the squared error of a picture is least for a number of bits, each Gaussian adds
the same, so t is proportional to (alpha s1 s2)^(-1/2). What is small is often seen from nearer, so
the square root of the area is taken instead.
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
    """How far numbers are rounded. ``python -m lab.judge.bytes`` judges them all together."""

    share: float = 0.55
    """Tolerance as a share of the error that a scene has already, by its PSNR."""
    share_without_sh: float = 0.85
    """The same for a scene of SH degree 0, which has no palette: the error of its renders is about
    half of the tolerance. Statues at 0.5 MB gain 0.3 to 1.1 dB over 0.55."""
    best_psnr: float = 45.0
    """PSNR, in dB, that a scene without error is taken to have."""
    contrast: float = 0.22
    """Contrast of a Gaussian with what is around it, a share of the colour range."""
    thinnest: float = 0.1
    """Least standard deviation along an axis, as a share of that along the longest: thinner ones
    are drawn thicker."""
    palette_error: float = 2.5
    """Error of the colours of a palette of SH, in tolerances. Finer colours take more bytes than
    fewer Gaussians."""
    most_rows: int = 32
    """Gaussians for each entry of the smallest palette."""


ROUNDING = RoundingSettings()


def rounding_for(psnr: float, sh_degree: int) -> float:
    """The rounding of a scene of some PSNR, dB, and SH degree: its tolerance, the error of the
    colour of a Gaussian of usual weight, as a share of the colour range."""
    share = ROUNDING.share if sh_degree else ROUNDING.share_without_sh
    return share * 10 ** (-min(psnr, ROUNDING.best_psnr) / 20)


class Steps(NamedTuple):
    """The largest steps that the numbers of N Gaussians may be rounded to, each (N, 1) float64."""

    sh: Tensor
    alphas: Tensor
    log_scales: Tensor
    means: Tensor  # world units
    quats: Tensor  # of quaternions of length 1


def weights(scene: Gaussians) -> Tensor:
    """How much the squared error of each Gaussian's colour counts, (N,) float64, up to a common
    factor."""
    sizes = scene.scales.double().sort(dim=1).values
    logs = scene.alphas.double().clamp_min(1 / 255).log().flatten() + sizes[:, 1] + sizes[:, 2]
    return (0.5 * (logs - logs.mean())).exp() if len(scene) else logs


def steps_of(scene: Gaussians, tolerance: float) -> Steps:
    """The steps of N usable Gaussians on the CPU, for a tolerance of a Gaussian of usual weight."""
    each = (tolerance * weights(scene).rsqrt())[:, None]
    uniform = math.sqrt(12)  # steps of rounding for a root mean squared error of 1
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
    """A scene of N usable Gaussians, float32 on the CPU, of which every number is a multiple of the
    largest power of two that its step allows, for a tolerance above 0 of a Gaussian of usual
    weight."""
    if not len(scene):
        return scene
    steps = steps_of(scene, tolerance)
    return rounded_shapes(scene, steps).replace(
        means=multiples(scene.means.double(), steps.means).float(),
        features_rest=multiples(scene.features_rest.double(), steps.sh[:, None]).float(),
    )


def rounded_shapes(scene: Gaussians, steps: Steps) -> Gaussians:
    """A scene of which all but positions and SH above degree 0 are rounded as by
    :func:`rounded`."""
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
    """Values rounded to multiples of the largest power of two within each step, which
    broadcasts."""
    steps = steps.clamp(2.0**-60, 2.0**60).log2().floor().exp2()
    return (values / steps).round() * steps
