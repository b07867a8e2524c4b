"""Features of each Gaussian for the feedback network: gradients so far, Adam's steps,
parameters."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.pipeline.optimiser import Adam, AdamSettings, Choose
from pointsplat_ns.refinement.feedback import FeedbackRefiner
from pointsplat_ns.scene.gaussians import PARAMETERS, Gaussians
from pointsplat_ns.system.pieces import pieces
from pointsplat_ns.system.threads import one_thread_each, parallel_for


@dataclass(frozen=True)
class RepairSettings:
    """Settings of the repair. Rates, decays and damping are tuned for the shipped network."""

    adam: AdamSettings = AdamSettings(faster=8.0, betas=(0.8, 0.98), damping=0.5)
    """The learning rates and decays of 3DGS suit 30,000 steps; repairs are shorter. Without
    damping, Adam moves all Gaussians equally far, even correct ones with tiny gradients. Half the
    rates without damping gain as much where a scene has errors, but disturb correct parts."""
    fewest_steps: int = 6
    """Features clamp smaller numbers of steps to this one."""
    nearly_right: float = 35.0
    """PSNR over the pixels that the dense scene covers, dB, above which learning rates fall with
    the root mean square error; see :func:`~pointsplat_ns.pipeline.repair.initial_rate_factor`. Full
    steps disturb a nearly correct scene. Gains in dB with reduced and with full rates: half of a
    kettle at 44 dB 1.7 and 0.2, half of a cake at 42 dB 2.0 and 0.3, half of a room at 40 dB 1.2
    and 0. Up to 36 dB, full rates gain most. Tuned on a bouquet, a cake, a kettle, a statue and two
    rooms."""
    last_factor: float = 0.02
    """Factor on the learning rates at the last step, see
    :func:`~pointsplat_ns.pipeline.repair.rate_factor`."""


REPAIR = RepairSettings()


class Feedback(Adam):
    """Adam with features of each Gaussian, from which a network chooses step lengths.

    Args:
        scene: K Gaussians before the first step.
        dense_count: number of Gaussians of the dense scene, N.
        settings: decays and damping.
    """

    def __init__(self, scene: Gaussians, dense_count: int, settings: AdamSettings = REPAIR.adam):
        super().__init__(scene, settings)
        self._gradients: dict[str, Tensor] = {}
        self._visibility = scene.means.new_zeros(len(scene), 1)
        self._log_keep = math.log10(len(scene) / dense_count)
        self._log_size = _bounded(scene.scales.detach()).mean(1).median()

    @torch.no_grad()
    def observe(self, gradients: dict[str, Tensor]) -> None:
        """Update the averages with the gradients of one view's loss, by parameter; all finite."""
        super().observe(gradients)
        self._gradients = gradients
        visible = (gradients["features_dc"] != 0).any(1, keepdim=True)
        self._visibility.lerp_(visible.to(self._visibility), 1 - self._settings.betas[1])

    def stepped(self, scene: Gaussians, gradients: dict[str, Tensor], choose: Choose) -> Gaussians:
        """As :meth:`Adam.stepped`; the choice of factors may use these gradients."""
        self.observe(gradients)
        return self.moved(scene, *choose(scene))

    def state(self) -> dict[str, Tensor]:
        """As :meth:`Adam.state`."""
        return {**super().state(), "visibility": self._visibility}

    @torch.no_grad()
    def factors(
        self, network: FeedbackRefiner, scene: Gaussians, done: float, steps: int
    ) -> Tensor:
        """Step factors (K, 6) that a network computes from :meth:`features`, which documents the
        other arguments. The network runs on pieces that fit a core's cache, one thread per piece,
        so the result does not depend on the number of threads."""
        factors = scene.means.new_empty(len(scene), len(PARAMETERS))

        def fill(rows: slice) -> None:
            features = self.features(scene, done, min(steps, network.most_steps), rows)
            factors[rows] = network(features).to(factors)

        with one_thread_each():
            parallel_for(fill, pieces(len(scene), scene.device, 1 << 12), scene.device)
        return factors

    @torch.no_grad()
    def features(
        self, scene: Gaussians, done: float, steps: int, rows: slice = slice(None)
    ) -> Tensor:
        """Features of each Gaussian, scaled to order 1.

        - for each parameter, over its components: logarithm of the root mean square gradient in
          units of the damping; norm of the mean gradient over it; logarithm of the last gradient
          over it
        - Adam's steps for scales, opacity and colour
        - opacity, size relative to the median Gaussian, shape, colour, share of views in which it
          is visible
        - common to all Gaussians: share of the steps done, logarithms of the number of steps and of
          the share of Gaussians that remain

        Args:
            scene: K Gaussians before this step.
            done: share of the steps done, in [0, 1].
            steps: total number of steps.
            rows: Gaussians to compute features for; by default all.

        Returns:
            (K, 39) float32, finite.
        """
        scales, opacities, colours = (
            values[rows] for values in (scene.scales, scene.opacities, scene.features_dc)
        )
        columns: list[Tensor] = []
        least = 1e-3  # share of the damping in denominators
        for name in PARAMETERS:
            if self._first[name].numel() == 0:
                columns.append(scales.new_zeros(len(scales), 3))
                continue
            unit = self._epsilon(name)
            squares = (self._second[name][rows] / self._weight_sum(1)).flatten(1)
            size = squares.mean(1, keepdim=True).sqrt()
            mean = _rms(self._first[name][rows] / self._weight_sum(0))
            last = _rms(self._gradients[name][rows])
            columns += [
                torch.log10(size / unit + 1e-4) / 2,
                mean / (size + least * unit),
                torch.log10(last / (size + least * unit) + 1e-2) / 2,
            ]
        columns += [
            self._directions[name][rows].clamp(-3, 3)
            for name in ("scales", "opacities", "features_dc")
        ]
        scales = _bounded(scales)
        mean = scales.mean(1, keepdim=True)
        columns += [
            opacities.clamp(-12, 12) / 4,
            ((mean - self._log_size) / 2).clamp(-4, 4),
            ((scales.amax(1, keepdim=True) - mean) / 2).clamp(0, 4),
            ((mean - scales.amin(1, keepdim=True)) / 2).clamp(0, 4),
            ((scales - mean) / 2).clamp(-4, 4),
            colours.clamp(-4, 4) / 2,
            self._visibility[rows] / self._weight_sum(1),
        ]
        log_steps = math.log10(max(steps, REPAIR.fewest_steps))
        common = scene.means.new_tensor([done, log_steps, self._log_keep]).expand(len(scales), 3)
        return torch.cat([*columns, common], dim=1).float().clamp_(-8, 8).nan_to_num_(0.0)


def _rms(values: Tensor) -> Tensor:
    """Root mean square of each row, (K, 1)."""
    return values.flatten(1).square().mean(1, keepdim=True).sqrt()


def _bounded(log_scales: Tensor) -> Tensor:
    return log_scales.clamp(-30, 30)
