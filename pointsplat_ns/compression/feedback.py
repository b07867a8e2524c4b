"""What the network of repairs sees of each Gaussian: the gradients so far, Adam's steps, and the Gaussian itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.compression.optimiser import Adam, AdamSettings
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner.feedback import PARAMETERS


@dataclass(frozen=True)
class RepairSettings:
    """Settings of repairs. Rates, decays and damping were tuned with the network that ships; another network may want
    others."""

    adam: AdamSettings = AdamSettings(faster=8.0, betas=(0.8, 0.98), damping=0.5)
    """The learning rates of 3DGS suit 30,000 steps, and its decays as well; repairs are shorter. Without damping, Adam
    moves all Gaussians equally far, also those that are right already and have next to no gradients. Half the rates
    without damping gain as much where a scene is wrong, but disturb what was right."""
    fewest_steps: int = 6
    """Least number of steps that the network was trained for; it is told no smaller number."""
    most_steps: int = 32
    """Largest number of steps that the network was trained for; it is told no larger number."""
    nearly_right: float = 35.0
    """PSNR over the pixels that the dense scene covers, in dB, above which the learning rates fall with the root mean
    square error, see :func:`~pointsplat_ns.compression.repair.share_of_start`. Steps of full size disturb a scene that
    is nearly right: from 44 dB, half of a kettle gains 1.7 dB at a third of the rates and 0.2 at all of them; from 42
    dB, half of a cake 2.0 and 0.3; from 40 dB, half of a room 1.2, at half of the rates, and nothing. From 36 dB and
    below all of the rates gain most. (Tuned on a bouquet, a cake, a kettle, a statue and two rooms.)"""
    last_share: float = 0.02
    """Share of the learning rates at the last step, see :func:`~pointsplat_ns.compression.repair.share_of_rates`."""


REPAIR = RepairSettings()

_SHOWN = ("scales", "opacities", "features_dc")
"""Kinds of parameters whose steps a network sees."""

_SMALL = 1e-3
"""Share of the damping that is added to denominators."""


class Feedback(Adam):
    """Adam, and what a network sees of each Gaussian, so that it can choose the length of its steps.

    Args:
        scene: K Gaussians, at the start.
        dense_count: number of Gaussians of the dense scene, N.
        settings: decays and damping.
    """

    def __init__(self, scene: Gaussians, dense_count: int, settings: AdamSettings = REPAIR.adam):
        super().__init__(scene, settings)
        self._gradients: dict[str, Tensor] = {}
        self._seen = scene.means.new_zeros(len(scene), 1)
        self._log_keep = math.log10(len(scene) / dense_count)
        self._log_size = _bounded(scene.scales.detach()).mean(1).median()

    @torch.no_grad()
    def observe(self, gradients: dict[str, Tensor]) -> None:
        """Take in the gradients of the loss in one view, all finite, by parameter."""
        super().observe(gradients)
        self._gradients = gradients
        seen = (gradients["features_dc"] != 0).any(1, keepdim=True)
        self._seen.lerp_(seen.to(self._seen), 1 - self._settings.betas[1])

    @torch.no_grad()
    def features(self, scene: Gaussians, done: float, steps: int) -> Tensor:
        """What a network sees of each Gaussian, all of order 1.

        For each kind of parameter, over its components: the size of the gradients in units of the damping (logarithm),
        how much of it has one direction, and how large the last one was beside the others (logarithm). Then the steps
        of Adam for scales, opacity and colour; opacity, size beside the other Gaussians', shape, colour; in what share
        of the views it was seen; and, the same for all, the share of the steps taken, and the logarithms of the number
        of steps and of the share of Gaussians kept.

        Args:
            scene: K Gaussians as they are now.
            done: share of the steps taken, in [0, 1].
            steps: number of all steps.

        Returns:
            (K, 39) float32, finite.
        """
        columns: list[Tensor] = []
        for name in PARAMETERS:
            if self._first[name].numel() == 0:
                columns.append(scene.means.new_zeros(len(scene), 3))
                continue
            unit = self._epsilon(name)
            size = (self._second[name] / self._whole(1)).flatten(1).mean(1, keepdim=True).sqrt()
            mean, last = _rms(self._first[name] / self._whole(0)), _rms(self._gradients[name])
            columns += [
                torch.log10(size / unit + 1e-4) / 2,
                mean / (size + _SMALL * unit),
                torch.log10(last / (size + _SMALL * unit) + 1e-2) / 2,
            ]
        columns += [self._directions[name].clamp(-3, 3) for name in _SHOWN]
        scales = _bounded(scene.scales)
        mean = scales.mean(1, keepdim=True)
        columns += [
            scene.opacities.clamp(-12, 12) / 4,
            ((mean - self._log_size) / 2).clamp(-4, 4),
            ((scales.amax(1, keepdim=True) - mean) / 2).clamp(0, 4),
            ((mean - scales.amin(1, keepdim=True)) / 2).clamp(0, 4),
            ((scales - mean) / 2).clamp(-4, 4),
            scene.features_dc.clamp(-4, 4) / 2,
            self._seen / self._whole(1),
        ]
        known = math.log10(min(max(steps, REPAIR.fewest_steps), REPAIR.most_steps))
        same = scene.means.new_tensor([done, known, self._log_keep]).expand(len(scene), 3)
        return torch.cat([*columns, same], dim=1).float().clamp_(-8, 8).nan_to_num_(0.0)


def _rms(values: Tensor) -> Tensor:
    """Root mean square of each row, (K, 1)."""
    return values.flatten(1).square().mean(1, keepdim=True).sqrt()


def _bounded(log_scales: Tensor) -> Tensor:
    return log_scales.clamp(-30, 30)
