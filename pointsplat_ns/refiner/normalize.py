"""Normalises a scene to the unit cube, and computes the network's input features.

Positions are centred and divided by one extent, which keeps the aspect ratio; log-scales are shifted by the logarithm
of that extent. So the input does not depend on the scene's unit and position. Only the input is clamped: residuals are
added to the original parameters.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import zero_as_identity
from pointsplat_ns.refiner.sparse_ops import permute


@dataclass(frozen=True)
class InputRanges:
    """Units and limits that bring the network's input to order 1. Trained weights depend on them."""

    opacity_limit: float = 12.0
    """Bound of opacity logits, where opacity is 0 or 1 within 1e-5."""
    opacity_unit: float = 4.0
    """Divisor of opacity logits."""
    log_scale_centre: float = -5.0
    """Typical log of a standard deviation in the unit cube: 4 cm in a room of 6 m."""
    log_scale_unit: float = 2.0
    """Divisor of centred log-scales."""
    log_scale_limit: float = 6.0
    """Bound of centred and divided log-scales."""
    sh_limit: float = 8.0
    """Bound of SH coefficients; displayable colours need at most 1.8."""


RANGES = InputRanges()


@dataclass(frozen=True)
class UnitCube:
    """A cube in scene units; all fields in float64."""

    centre: Tensor  # [3] scene units
    extent: Tensor  # [] side of the cube, scene units, above 0

    def positions(self, means: Tensor) -> Tensor:
        """Positions in [-0.5, 0.5], float64; those outside the cube are clamped to it. # [N, 3]"""
        return ((means.double() - self.centre) / self.extent).clamp(-0.5, 0.5)

    def log_scales(self, scales: Tensor) -> Tensor:
        """Log-scales in units of the cube, in float64. # [N, 3]"""
        return scales.double() - self.extent.log()


def unit_cube(means: Tensor) -> UnitCube:
    """The unit cube of at least one finite position (N, 3), scene units.

    The core of the scene is the box of its positions without the outermost 1 % at each end of each axis (at least one
    position, from 8 positions on). The box of all positions is cut to the core plus half of the core's longest side in
    each direction. A scene without outliers keeps its full extent; an outlier at most doubles it. The cube has the
    centre and the longest side of the cut box, or side 1 where that is zero.
    """
    axes = means.detach().T.contiguous()  # [3, N]
    n = axes.shape[1]
    trim = max(1, math.ceil(0.01 * n)) if n >= 8 else 0
    low, high = (value.double() for value in axes.aminmax(dim=1))
    core_low, core_high = (axes.kthvalue(k, dim=1).values.double() for k in (trim + 1, n - trim))
    reach = 0.5 * (core_high - core_low).max()
    if reach > 0:
        low, high = torch.maximum(low, core_low - reach), torch.minimum(high, core_high + reach)
    extent = (high - low).max()
    return UnitCube(low + (high - low) / 2, torch.where(extent > 0, extent, torch.ones_like(extent)))


@dataclass(frozen=True)
class Features:
    """The network's input for N Gaussians: finite, of order 1, the same for quaternions q and -q."""

    positions: Tensor  # [N, 3] unit cube, centred at 0
    quats: Tensor  # [N, 4] unit wxyz, first non-zero component positive
    scales: Tensor  # [N, 3] log-scale in the unit cube, centred and scaled
    opacities: Tensor  # [N, 1] logit, scaled
    features_dc: Tensor  # [N, 3]
    features_rest: Tensor  # [N, 3 * num_rest] zero above the scene's degree
    quat_scale: Tensor  # [N, 1] signed length: the scene's quaternion is this times ``quats``

    def permute(self, order: Tensor, inverse: Tensor) -> Features:
        """Rows in another order, given with its inverse. # [N], [N] int64"""
        return Features(**{f.name: permute(getattr(self, f.name), order, inverse) for f in dataclasses.fields(self)})


def gaussian_features(scene: Gaussians, cube: UnitCube, num_rest: int, dtype: torch.dtype) -> Features:
    """Network input of a scene of N usable Gaussians, with its unit cube, for so many SH coefficients of degree 1 and
    higher a colour channel, in the network's floating type."""
    log_scale_limit, sh_limit = RANGES.log_scale_limit, RANGES.sh_limit
    log_scales = (cube.log_scales(scene.scales) - RANGES.log_scale_centre) / RANGES.log_scale_unit
    logits = scene.opacities.clamp(-RANGES.opacity_limit, RANGES.opacity_limit) / RANGES.opacity_unit
    quats, quat_scale = canonical_quats(scene.quats)
    rest = scene.features_rest.flatten(1).clamp(-sh_limit, sh_limit).to(dtype)
    return Features(
        positions=cube.positions(scene.means).to(dtype),
        quats=quats.to(dtype),
        scales=log_scales.clamp(-log_scale_limit, log_scale_limit).to(dtype),
        opacities=logits.to(dtype),
        features_dc=scene.features_dc.clamp(-sh_limit, sh_limit).to(dtype),
        features_rest=torch.nn.functional.pad(rest, (0, 3 * num_rest - rest.shape[1])),
        quat_scale=quat_scale,
    )


def canonical_quats(quats: Tensor) -> tuple[Tensor, Tensor]:
    """Unit quaternions (N, 4) of one sign, and their signed lengths (N, 1), of finite wxyz of any length.

    A quaternion and its negative are the same rotation; the first non-zero component of the result is positive.
    Quaternions shorter than :data:`~pointsplat_ns.geometry.transforms.SHORTEST` become the identity, with a length of
    1. Components are divided by the largest before squaring, so that 1e-30 does not underflow and 1e30 does not
    overflow.
    """
    quats = zero_as_identity(quats)
    largest = quats.abs().amax(dim=1, keepdim=True).detach()
    scaled = quats / largest
    length = scaled.norm(dim=1, keepdim=True)
    first = (scaled != 0).to(torch.uint8).argmax(dim=1, keepdim=True)
    sign = torch.where(scaled.gather(1, first) < 0, -1.0, 1.0).to(quats.dtype)
    top = torch.finfo(quats.dtype).max
    signed = (sign * length * largest).clamp(-top, top)
    return scaled * sign / length, signed
