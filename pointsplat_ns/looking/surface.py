"""Points on the surfaces of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.looking.content import UNITS, positions_in_units
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.system.tensors import DOUBLES


@dataclass(frozen=True, eq=False)
class Surface:
    """Points drawn from the Gaussians of a scene, in units of its content. A point lies within its Gaussian."""

    points: Tensor  # [M, 3] float64
    normals: Tensor  # [M, 3] float64 along the shortest axis of the Gaussian, of either sign
    flatness: Tensor  # [M] float64 in [0, 1]: 1 less the ratio of the shortest axis to the next

    @staticmethod
    def of(scene: Gaussians, centre: Tensor, size: float) -> Surface:
        """The points of a scene. Deterministic.

        Args:
            scene: N Gaussians, at least one of them visible.
            centre: (3,) of its content.
            size: diagonal of its content, scene units.
        """
        generator = torch.Generator().manual_seed(0)
        cumulative = _chances(scene).cpu().cumsum(0)
        count = 12_288
        drawn = torch.rand(count, generator=generator, **DOUBLES) * cumulative[-1]
        some = scene[torch.searchsorted(cumulative, drawn).clamp_max(len(scene) - 1).to(scene.device)].to("cpu")
        # exp(scale) may be infinite; a point that far away is as good as one at a million times the content's size.
        stds, order = (some.stds.double() * (UNITS / size)).clamp_max(1e6 * UNITS).sort(dim=1)
        axes = rotation_matrices(some.quats.double())  # columns are the axes
        axes = axes.gather(2, order[:, None, :].expand(-1, 3, 3))
        offsets = torch.randn(count, 3, generator=generator, **DOUBLES).clamp(-1.5, 1.5) * stds
        points = positions_in_units(some.means, centre.cpu(), size) + (axes @ offsets[..., None])[..., 0]
        flatness = 1 - stds[:, 0] / stds[:, 1].clamp_min(1e-300)
        return Surface(points, axes[:, :, 0], flatness)

    def __getitem__(self, rows: Tensor | slice) -> Surface:
        """Some of the points."""
        return Surface(self.points[rows], self.normals[rows], self.flatness[rows])


def _chances(scene: Gaussians) -> Tensor:
    """Relative chances (N,) of the Gaussians to be drawn, float64. If no Gaussian has an area, all that are clear have
    the same."""
    usable, alphas = scene.usable(), scene.alphas.detach().double()
    clear = usable & (alphas >= min(LOOKING.min_opacity, float(alphas[usable].max())))
    log_areas = F.logsigmoid(scene.opacities[:, 0].double()) + scene.scales.double().topk(2).values.sum(1)
    logs = LOOKING.surface_exponent * log_areas.clamp_min(torch.finfo(torch.float64).min)
    ranked = logs[clear].sort().values
    bounded = logs.clamp_max(ranked[int(LOOKING.max_area_quantile * (len(ranked) - 1))])
    return torch.where(clear, (bounded - ranked[-1]).exp(), 0.0)
