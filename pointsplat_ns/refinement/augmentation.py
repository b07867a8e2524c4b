"""Data augmentation: rotations, reflections and colour changes of scenes.

A :class:`Transform` has an inverse. A refiner trained on ``undo(refiner(apply(scene)))`` gets many
variants of a scene, while the target images do not change.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.rotation import turned
from pointsplat_ns.system.tensors import DOUBLES, FLOATS


@dataclass(frozen=True, eq=False)
class Transform:
    """Rotates a scene about the origin, reflects it through the origin if ``mirrored``, and scales
    and permutes its colour channels."""

    quat: Tensor  # [4] wxyz, unit
    mirrored: bool
    gains: Tensor  # [3] factor on each channel, above 0
    channels: Tensor  # [3] int64: channel i of the result is channel ``channels[i]`` of the scene

    @cached_property
    def matrix(self) -> Tensor:
        """Orthogonal (3, 3) float64, the factor on positions."""
        return rotation_matrices(self.quat.double()[None])[0] * (-1.0 if self.mirrored else 1.0)

    def apply(self, scene: Gaussians) -> Gaussians:
        """The transformed scene."""
        gains, middle = self._color(scene)
        moved = turned(scene, self.matrix, self.quat)
        return moved.replace(
            features_dc=(scene.features_dc * gains + middle)[:, self.channels],
            features_rest=(moved.features_rest * gains)[..., self.channels],
        )

    def undo(self, scene: Gaussians) -> Gaussians:
        """The inverse of :meth:`apply`."""
        gains, middle = self._color(scene)
        back = self.channels.argsort()
        moved = turned(
            scene, self.matrix.T, self.quat * self.quat.new_tensor([1.0, -1.0, -1.0, -1.0])
        )
        return moved.replace(
            features_dc=(scene.features_dc[:, back] - middle) / gains,
            features_rest=moved.features_rest[..., back] / gains,
        )

    def _color(self, scene: Gaussians) -> tuple[Tensor, Tensor]:
        """Factors on SH coefficients, and the offset of the constant ones. Colours are 0.5 + SH_C0
        dc, so a factor on colours changes the 0.5 too."""
        gains = self.gains.to(scene.means)
        return gains, 0.5 * (gains - 1.0) / SH_C0


def random_transform(generator: torch.Generator | None = None) -> Transform:
    """A random transform: a rotation (half of the time about z, as most scenes have z up), a
    reflection or none, gains and order of the colour channels."""
    upright, mirrored = (
        torch.rand(2, generator=generator, **FLOATS) < torch.tensor([0.5, 0.5], **FLOATS)
    ).tolist()
    quat = torch.randn(4, generator=generator, **DOUBLES)
    if upright:
        quat[1:3] = 0.0
    # of the factors on colour channels
    low = 0.7
    high = 1.4
    gains = low * (high / low) ** torch.rand(3, generator=generator, **DOUBLES)
    return Transform(
        quat / quat.norm(), mirrored, gains, torch.randperm(3, generator=generator, device="cpu")
    )
