"""What gradients have said of each Gaussian so far, and the steps that follow from it: Adam's, or learned ones."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.compression.optimiser import RATES, extent, seen_rms
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.refiner.feedback import PARAMETERS

FASTER = 8.0
"""Factor on the learning rates of 3DGS, which suit 30,000 steps."""

BETAS = (0.8, 0.98)
"""Decays of Adam's averages of the gradient and of its square: shorter than usual, as there are few steps."""

DAMPING = 0.5
"""Adam's epsilon, as a share of the root mean square of a parameter's gradient over what is seen in the first step that
sees any. Adam moves all Gaussians equally far, also those that are right already and have next to no gradients; what is
damped moves less. Half the rates without it gain as much where a scene is wrong, but disturb what was right."""

_SHOWN = ("scales", "opacities", "features_dc")
"""Kinds of parameters whose steps a network sees."""

FEWEST_STEPS, MOST_STEPS = 6, 32
"""Numbers of steps that the network was trained for; others are shown to it as the nearest of these."""

_SMALL = 1e-3
"""Share of the damping that is added to denominators."""


class Feedback:
    """Averages of the gradients of a scene's parameters, what a network sees of them, and the steps.

    Args:
        scene: K Gaussians, at the start.
        dense_count: number of Gaussians of the dense scene, N.
    """

    def __init__(self, scene: Gaussians, dense_count: int):
        reach = extent(scene)
        self.rates = {name: FASTER * RATES[name] * (reach if name == "means" else 1.0) for name in PARAMETERS}
        self._first = {name: torch.zeros_like(value) for name, value in scene.items()}
        self._second = {name: torch.zeros_like(value) for name, value in scene.items()}
        self._gradients: dict[str, Tensor] = {}
        self._damping = dict.fromkeys(PARAMETERS, 0.0)
        self._directions: dict[str, Tensor] = {}
        self._seen = scene.means.new_zeros(len(scene), 1)
        self._log_keep = math.log10(len(scene) / dense_count)
        self._log_size = _bounded(scene.scales.detach()).mean(1).median()
        self._steps = 0

    @torch.no_grad()
    def observe(self, gradients: dict[str, Tensor]) -> None:
        """Take in the gradients of the loss in one view, all finite, by parameter."""
        self._steps += 1
        self._gradients = gradients
        for name in PARAMETERS:
            gradient = gradients[name]
            self._damping[name] = self._damping[name] or DAMPING * seen_rms(gradient)
            self._first[name].lerp_(gradient, 1 - BETAS[0])
            self._second[name].mul_(BETAS[1]).addcmul_(gradient, gradient, value=1 - BETAS[1])
            root = (self._second[name] / self._whole(1)).sqrt_()
            self._directions[name] = (self._first[name] / self._whole(0)).div_(root.add_(self._epsilon(name)))
        seen = (gradients["features_dc"] != 0).any(1, keepdim=True)
        self._seen.lerp_(seen.to(self._seen), 1 - BETAS[1])

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
        known = math.log10(min(max(steps, FEWEST_STEPS), MOST_STEPS))
        same = scene.means.new_tensor([done, known, self._log_keep]).expand(len(scene), 3)
        return torch.cat([*columns, same], dim=1).float().clamp_(-8, 8).nan_to_num_(0.0)

    def moves(self, share: float, factors: Tensor | None = None) -> dict[str, Tensor]:
        """What to add to each parameter: Adam's steps, multiplied by factors.

        Args:
            share: of the learning rates.
            factors: (K, 6), one a kind of parameter; None is 1.
        """
        moves = {}
        for kind, name in enumerate(PARAMETERS):
            step = self._directions[name]
            if factors is not None:
                step = step * factors[:, kind].to(step).view(-1, *[1] * (step.dim() - 1))
            moves[name] = step * (-share * self.rates[name])
        return moves

    def moved(self, scene: Gaussians, share: float, factors: Tensor | None = None) -> Gaussians:
        """A scene after a step; arguments as for :meth:`moves`."""
        moves = self.moves(share, factors)
        return Gaussians(**{name: value + moves[name] for name, value in scene.items()})

    def _whole(self, which: int) -> float:
        """What an average that began at 0 is divided by."""
        return 1 - BETAS[which] ** self._steps

    def _epsilon(self, name: str) -> float:
        return max(self._damping[name], 1e-15)


def _rms(values: Tensor) -> Tensor:
    """Root mean square of each row, (K, 1)."""
    return values.flatten(1).square().mean(1, keepdim=True).sqrt()


def _bounded(log_scales: Tensor) -> Tensor:
    return log_scales.clamp(-30, 30)
