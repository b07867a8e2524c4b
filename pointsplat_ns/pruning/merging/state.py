"""The participants of merging, and the state of the remaining Gaussians in a round."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import bulk_cube, curve_keys, unit_cells
from pointsplat_ns.pruning.merging.covariance import covariances_of, widened
from pointsplat_ns.rendering.constants import ALPHA_MIN
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.pieces import in_pieces, pieces
from pointsplat_ns.system.tensors import DOUBLES, numbers
from pointsplat_ns.system.threads import parallel_map
from pointsplat_ns.view_sampling.content import content_size

SAMPLED = 1 << 18
"""Maximum number of Gaussians that determine the curve and the borders of cells."""


def sampled_step(count: int) -> int:
    """Step n such that every n-th of ``count`` Gaussians determines curve and cell borders."""
    return -(-count // SAMPLED)


@dataclass(frozen=True, eq=False)
class Participants:
    """The Gaussians to be merged, and the scene that contains them."""

    scene: Gaussians  # N Gaussians; merging computes on their device
    # [n] int64, indices in the scene, along a space-filling curve: neighbours are near in memory
    members: Tensor
    centre: Tensor  # [3] float64, on the CPU, of the scene's content
    size: float
    """Diagonal of the scene's content, scene units."""
    # [n] float32 in [0, 1], variances that the rasterizer's blur adds, in units of the squared
    # size; None for scenes that are not mostly blur
    blurs: Tensor | None = None

    @classmethod
    def of(cls, scene: Gaussians, members: Tensor) -> Participants:
        """The participants ``members`` (n,) of a scene, on its device."""
        some = members[members % sampled_step(len(scene)) == 0]
        cube = bulk_cube(scene.means[some if len(some) else members])
        order = curve_keys(unit_cells(scene.means[members], cube)).argsort(stable=True)
        return cls(scene, members[order], *content_size(scene))

    def __len__(self) -> int:
        return len(self.members)

    def cov(self, these: Tensor | slice) -> Tensor:
        """Covariances (m, 6) float64 of the participants ``these``, widened by their blurs, squared
        scene units."""
        cov = covariances_of(self.scene, self.members[these])
        if self.blurs is None:
            return cov
        return widened(cov, self.blurs[these].double() * self.size**2)

    def most_opaque(self, k: int) -> Tensor:
        """Ascending indices (k,) in the scene of the most opaque participants; of equals, random
        ones, which are spread over the scene."""
        generator = torch.Generator().manual_seed(0)
        order = torch.randperm(len(self), generator=generator).to(self.members.device)
        rows = self.members[order]
        opacities = self.scene.opacities[rows, 0]
        return rows[opacities.argsort(descending=True, stable=True)[:k]].sort().values


def drawable(scene: Gaussians, k: int) -> Tensor:
    """Ascending indices of the Gaussians that can be drawn; if they are fewer than ``k``, also of
    the most opaque ones that are too faint.

    Raises:
        BudgetError: if fewer than ``k`` have finite parameters.
    """
    usable = scene.usable()
    if int(usable.sum()) < k:
        raise BudgetError(
            f"cannot keep {k} Gaussians: {int(usable.sum())} of {len(scene)} have finite parameters"
        )
    chosen = usable & (scene.alphas >= ALPHA_MIN)
    missing = k - int(chosen.sum())
    if missing > 0:
        faint = usable & ~chosen
        order = (
            torch.where(faint, scene.opacities[:, 0], -math.inf)
            .sort(descending=True, stable=True)
            .indices
        )
        chosen[order[faint[order]][:missing]] = True
    return chosen.nonzero()[:, 0]


@dataclass(frozen=True, eq=False)
class State:
    """The Gaussians that remain after the rounds so far.

    float32 is sufficient: costs are float32, and the shapes of groups are recomputed at the end.
    """

    means: Tensor  # [n, 3] float32, relative to the centre, in units of the size
    # [n, 6] float32, with blur, in units of the squared size, clamped to the range of float32
    cov: Tensor
    alphas: Tensor  # [n] float32
    colours: Tensor  # [n, C] float32 on principal axes, colour units
    weights: Tensor  # [n] float32, visibility weight per unit of area
    counts: Tensor  # [n] int32, number of Gaussians merged into each

    def __len__(self) -> int:
        return len(self.means)


def initial_state(
    participants: Participants,
    weights: Tensor,
    colour_axes: tuple[Tensor, Tensor] | None = None,
    dtype: torch.dtype = torch.float32,
) -> State:
    """The state before the first round.

    Args:
        participants: n Gaussians of a scene.
        weights: (n,) visibility weight of each per unit of area.
        colour_axes: as of :func:`principal_axes`; by default those of the participants.
        dtype: float64 for a reference, which kernels do not support.
    """
    scene = participants.scene
    members = participants.members
    centre = participants.centre.to(members.device, torch.float64)
    size = participants.size
    middle, axes = colour_axes or principal_axes(scene, members)
    return State(
        means=in_pieces(
            lambda rows: (scene.means[rows].double() - centre) / size, members, 3, dtype=dtype
        ),
        cov=in_pieces(
            lambda these: (participants.cov(these) / size**2).clamp(-1e30, 1e30),
            numbers(len(members), members.device),
            6,
            dtype=dtype,
        ),
        alphas=torch.sigmoid(scene.opacities[members, 0]).to(dtype),
        colours=in_pieces(
            lambda rows: (_coefficients(scene, rows) - middle) @ axes,
            members,
            axes.shape[1],
            dtype=torch.float32,
        ),
        weights=weights.float(),
        counts=torch.ones_like(members, dtype=torch.int32),
    )


def bounded_colours(coefficients: Tensor) -> Tensor:
    """SH coefficients in colour units, float32, clamped, so that a few broken colours do not hide
    all others."""
    return (coefficients.float() * SH_C0).clamp_(-10.0, 10.0)


def _coefficients(scene: Gaussians, rows: Tensor) -> Tensor:
    """All SH coefficients (m, 3 (d+1)^2) of rows (m,), in colour units."""
    parts = scene.features_dc[rows], scene.features_rest[rows].reshape(len(rows), -1)
    return bounded_colours(torch.cat(parts, dim=1))


def principal_axes(scene: Gaussians, members: Tensor) -> tuple[Tensor, Tensor]:
    """Mean of all SH coefficients of members (n,), (3 (d+1)^2,) float32, colour units, and their
    principal axes, (3 (d+1)^2, C) float32, orthonormal.

    By Parseval's theorem, the coefficients of every band contribute to the mean square over
    directions as the constant does. Eight axes hold nearly all of the variance.
    """
    width = 3 + 3 * scene.features_rest.shape[1]
    first, *_ = parts = pieces(len(members), members.device)
    # near the mean, so that squares fit into float32
    shift = _coefficients(scene, members[first]).mean(0)
    total, products = (
        torch.zeros(*shape, **DOUBLES).to(members.device) for shape in ((width,), (width, width))
    )

    def sums(these: slice) -> tuple[Tensor, Tensor]:
        values = _coefficients(scene, members[these]) - shift
        return values.sum(0), values.T @ values

    for values, squares in parallel_map(sums, parts, members.device):
        total += values
        products += squares
    mean = total / len(members)
    covariance = products - len(members) * mean[:, None] * mean
    axes = torch.linalg.eigh(covariance.cpu()).eigenvectors[:, -8:]
    return (shift + mean).float(), axes.float().to(members.device)
