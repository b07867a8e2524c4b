"""The network's input and residuals in local units: the spacing of each Gaussian's neighbours.

In the published network positions and sizes are shares of the scene's extent, so a number means
another thing in a piece of a scene than in the whole, and in a scene of twice as many Gaussians.
Here the unit of each Gaussian is the mean distance to its nearest neighbours. Neither the input nor
the residuals depend on the scene's unit, position and extent; away from the border of a piece they
do not depend on where the scene was cut.

All quantities are those of one of the equal descriptions of a Gaussian: axes are sorted by their
length, and orientations are given as the matrix logarithm of the covariance, so that exchanged or
reversed axes change nothing. Rotations are about the axes of the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.geometry.neighbours import other_neighbours
from pointsplat_ns.geometry.transforms import rotation_matrices, zero_as_identity
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.tensors import numbers

NEIGHBOURS = 8
"""Nearest other Gaussians whose mean distance is the unit."""

SCALES_REACH = 3.0
"""Largest change of a log-scale: a factor of 20."""

LOG_RANGE = 8.0
"""Largest natural logarithm of a size, or of a spacing, over another that the network is given."""

FEWEST_SIZES = 20.0
"""Lengths of its longest axis that a Gaussian's unit of motion is at most: a stray Gaussian far
from all others is not moved far."""

SH_LIMIT = 8.0
"""Largest SH coefficient that the network is given; displayable colours need at most 1.8."""

GEOMETRY = 24
"""Numbers for each Gaussian in the geometry branch."""

APPEARANCE = 8
"""Numbers for each Gaussian in the appearance branch, without SH coefficients of degree 1 and
higher."""

OUTER = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""The different entries of a symmetric 3x3 matrix."""


@dataclass(frozen=True)
class LocalFeatures:
    """The network's input for N Gaussians: finite, of order 1.

    ``geometry`` has: the mean offset of the neighbours (3); the matrix logarithm of the covariance
    without its trace (6); the log-scales, the longest axis first (3); the second moments of the
    neighbours' offsets (6); the logarithms of the distances to the first, second and fourth
    neighbour (3); the mean differences of the neighbours' log-sizes and log-spacings (2); the
    logarithm of the share of the Gaussians that was kept (1). Lengths are in the unit.
    ``appearance`` has: the opacity logit (1), the constant SH coefficients (3), and the mean
    differences of the neighbours' from them (4).
    """

    positions: Tensor  # [N, 3] mean offset of the neighbours, units
    geometry: Tensor  # [N, GEOMETRY]
    appearance: Tensor  # [N, APPEARANCE]
    features_rest: Tensor  # [N, 3 * num_rest] zero above the scene's degree


@dataclass(frozen=True)
class LocalUnits:
    """Neighbours and unit of each of N Gaussians."""

    near: Tensor  # [N, K] int64 nearest other Gaussians; a Gaussian's own index stands for none
    unit: Tensor  # [N] mean distance to them, scene units, float64, above 0


@torch.no_grad()
def local_units(scene: Gaussians) -> LocalUnits:
    """Neighbours and units of N usable Gaussians, on the scene's device.

    A Gaussian without others, or among coincident ones alone, has its own mean size for a unit.
    """
    means = scene.means.detach().double()
    near = other_neighbours(means, NEIGHBOURS).long()
    exists = near != numbers(len(scene), means.device)[:, None]
    distances = (means[near] - means[:, None]).norm(dim=2)
    mean = distances.sum(dim=1) / exists.sum(dim=1).clamp(min=1)
    smallest = torch.finfo(torch.float32).tiny
    own = scene.scales.detach().double().clamp(-80.0, 80.0).mean(dim=1).exp()
    return LocalUnits(near, torch.where(mean > smallest, mean, own))


@torch.no_grad()
def local_features(
    scene: Gaussians, units: LocalUnits, num_rest: int, kept: float, dtype: torch.dtype
) -> LocalFeatures:
    """Network input of N usable Gaussians; the scene itself gets no gradient through it.

    Args:
        scene: N Gaussians.
        units: of these Gaussians.
        num_rest: SH coefficients of degree 1 and higher for each colour channel that the network
            takes.
        kept: share of the dense scene's Gaussians that was kept, in (0, 1].
        dtype: the network's floating type.
    """
    near = units.near
    unit = units.unit
    log_unit = unit.log()
    offsets = (scene.means.double()[near] - scene.means.double()[:, None]) / unit[:, None, None]
    offsets = offsets.clamp(-NEIGHBOURS, NEIGHBOURS)  # the mean length is 1
    scales = scene.scales.double().clamp(-1e3, 1e3) - log_unit[:, None]
    scales = scales.clamp(-LOG_RANGE, LOG_RANGE)
    longest_first = scales.sort(dim=1, descending=True).values
    level = scales.mean(dim=1, keepdim=True)
    axes = rotation_matrices(zero_as_identity(scene.quats).double())
    covariance = (axes * (scales - level)[:, None]) @ axes.transpose(1, 2)  # of logarithms
    moments = (offsets[:, :, :, None] * offsets[:, :, None]).mean(dim=1)
    lengths = offsets.norm(dim=2).sort(dim=1).values[:, [0, 1, 3]]
    size = longest_first[:, :2].mean(dim=1) + log_unit
    size_difference = size[near].mean(dim=1) - size
    unit_difference = log_unit[near].mean(dim=1) - log_unit
    share = torch.full_like(log_unit, math.log(kept))
    geometry = [
        offsets.mean(dim=1),
        *((covariance[:, i, j] / 2)[:, None] for i, j in OUTER),
        (longest_first + 1.5) / 2,
        *(moments[:, i, j][:, None] for i, j in OUTER),
        lengths.clamp(min=1e-3).log(),
        torch.stack([size_difference, unit_difference], dim=1).clamp(-LOG_RANGE, LOG_RANGE),
        (share[:, None] + 1.5) / 1.5,
    ]
    logits = scene.opacities.double().clamp(-12.0, 12.0) / 4
    colors = scene.features_dc.double().clamp(-SH_LIMIT, SH_LIMIT)
    own = torch.cat([logits, colors], dim=1)
    rest = scene.features_rest.flatten(1).clamp(-SH_LIMIT, SH_LIMIT).to(dtype)
    return LocalFeatures(
        positions=geometry[0].to(dtype),
        geometry=torch.cat(geometry, dim=1).to(dtype),
        appearance=torch.cat([own, own[near].mean(dim=1) - own], dim=1).to(dtype),
        features_rest=torch.nn.functional.pad(rest, (0, 3 * num_rest - rest.shape[1])),
    )


def moved_in_local_units(
    scene: Gaussians, units: LocalUnits, residuals: dict[str, Tensor]
) -> Gaussians:
    """A scene of N Gaussians with residuals in local units added.

    Args:
        scene: N Gaussians.
        units: of these Gaussians.
        residuals: ``means`` (N, 3) in units, along the axes of the world; ``scales`` (N, 3), of the
            longest axis first, any number, bounded here to :data:`SCALES_REACH`; ``quats`` (N, 3),
            a rotation vector about the axes of the world; the others as the container stores them.
    """
    dtype = scene.dtype
    longest = scene.scales.detach().double().clamp(-80.0, 80.0).amax(dim=1).exp()
    reach = torch.minimum(units.unit, FEWEST_SIZES * longest)[:, None]
    means = scene.means + (residuals["means"].double() * reach).to(dtype)
    order = scene.scales.detach().sort(dim=1, descending=True).indices
    sorted_steps = SCALES_REACH * (residuals["scales"] / SCALES_REACH).tanh()
    steps = torch.zeros_like(sorted_steps).scatter(1, order, sorted_steps).to(dtype)
    quats = zero_as_identity(scene.quats)
    turned = quats + 0.5 * _times_rotation_vector(residuals["quats"].to(dtype), quats)
    changes = {
        name: getattr(scene, name) + residuals[name].to(dtype)
        for name in ("opacities", "features_dc")
    }
    if scene.features_rest.shape[1]:
        rest = residuals["features_rest"].to(dtype).view(len(scene), -1, 3)
        changes["features_rest"] = scene.features_rest + rest[:, : scene.features_rest.shape[1]]
    return scene.replace(means=means, scales=scene.scales + steps, quats=turned, **changes)


def _times_rotation_vector(vectors: Tensor, quats: Tensor) -> Tensor:
    """Products of the quaternions (0, vectors) and (N, 4) wxyz: twice the change of these in a
    small rotation about the axes of the world."""
    x, y, z = vectors.unbind(1)
    w, a, b, c = quats.unbind(1)
    return torch.stack(
        [
            -x * a - y * b - z * c,
            x * w + y * c - z * b,
            y * w + z * a - x * c,
            z * w + x * b - y * a,
        ],
        dim=1,
    )
