"""Densification up to a given number of Gaussians: 3DGS-MCMC (Kheradmand et al., "3D Gaussian Splatting as Markov Chain
Monte Carlo", NeurIPS 2024, arXiv 2404.09591), in steps that suit short trainings.

Gaussians that have become transparent move to opaque ones, and new ones appear there, until the number is reached. What
is at one place then shares its opacity and becomes smaller, so that the picture hardly changes. After each step noise
moves the nearly transparent ones, so that they find places of use.

What each part is worth, at 1,494 Gaussians and 600 steps (vr_project, held-out photos): the weights on opacity and size
0.7 dB, noise 0.5 dB, averages of the optimiser that start anew where Gaussians moved 1.0 dB.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import torch
from gsplat.strategy.base import Strategy
from torch import Tensor
from torch.nn.functional import logsigmoid
from torch.optim import Optimizer

from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.system.threads import one_thread


@dataclass
class CappedStrategy(Strategy):
    """Densification with a cap, called by Splatfacto after each step as gsplat's strategies are."""

    most: int
    """Number of Gaussians that is reached, and never exceeded."""
    first_step: int
    """There is no densification up to this step."""
    full_from: int
    """Step at which the number is reached."""
    last_step: int
    """There is no densification from this step on."""
    every: int
    """Number of steps from one densification to the next."""
    absgrad: bool = False
    """Whether the rasterizer has to keep the absolute gradients of projected centres."""

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """What is gathered from step to step: nothing."""
        return {}

    @torch.no_grad()
    def step_post_backward(
        self,
        params: MutableMapping[str, torch.nn.Parameter],
        optimizers: Mapping[str, Optimizer],
        state: dict[str, Any],
        step: int,
        info: dict[str, Any],
        packed: bool = False,
    ) -> None:
        """Move, add and shake Gaussians after a step; not after one that showed none, such as one that was skipped."""
        if not info["radii"].any():
            return
        with one_thread():  # sums that decide what is drawn must not depend on the number of threads
            if step % self.every == 0 and self.first_step < step < self.last_step:
                self._densify(params, optimizers, step)
            noise = position_noise(params["scales"], params["quats"], params["opacities"])
            params["means"].add_(noise, alpha=5e5 * optimizers["means"].param_groups[0]["lr"])

    def _densify(
        self, params: MutableMapping[str, torch.nn.Parameter], optimizers: Mapping[str, Optimizer], step: int
    ) -> None:
        num = len(params["means"])
        opacities = torch.sigmoid(params["opacities"][:, 0])
        dead = opacities <= 0.005
        if dead.all():
            return
        count = next_count(num, self.most, (self.full_from - 1 - step) // self.every)
        places = torch.cat([dead.nonzero()[:, 0], torch.arange(num, count, device=dead.device, dtype=torch.int64)])
        sources = drawn(opacities.masked_fill(dead, 0.0), len(places))
        rows = torch.arange(count, device=dead.device, dtype=torch.int64)
        rows[places] = sources
        changed = torch.cat([sources.unique(), places])
        copies = 1 + torch.bincount(sources, minlength=num)[rows[changed]]
        shared = shared_opacity(params["opacities"][rows[changed], 0], params["scales"][rows[changed]], copies)
        for name, value in params.items():
            new = value.detach()[rows]
            if name == "opacities":
                new[changed, 0] = shared[0]
            elif name == "scales":
                new[changed] = shared[1]
            params[name] = replaced(optimizers[name], value, new, rows, changed)


def shared_opacity(opacities: Tensor, scales: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacities and scales of M Gaussians, each of which becomes several at its place, so that a ray through the centre
    passes as much light as before and the sum over the ray's distance from it is the same.

    The formulas are those of the paper's equation 9. With o' = 1 - (1 - o)^(1/n) of n copies, its double sum over
    binomials is the integral of 1 - (1 - o' exp(-x^2))^n over all x, divided by the root of pi; the alternating terms
    of the sum cancel, the integrand is positive and smooth, and the trapezoidal rule gives it to rounding.

    Args:
        opacities: (M,) logits.
        scales: (M, 3) natural logarithms.
        copies: (M,) number of copies, at least 1.

    Returns:
        (M,) logits and (M, 3) natural logarithms, of each copy. Logits below -80 and above 16 count as these.
    """
    logits = opacities.double().clamp(-80.0, 16.0)  # outside, an opacity is 0 or 1 in float32
    numbers = copies.double()
    passed = logsigmoid(-logits) / numbers  # log(1 - o')
    opacity = -torch.expm1(passed)
    x = torch.linspace(0.0, 7.0, 113, dtype=torch.float64, device=logits.device)  # steps of 1/16; exp(-49) is nothing
    covered = -torch.expm1(numbers[:, None] * torch.log1p(-opacity[:, None] * torch.exp(-(x**2))))
    integral = (2 * covered.sum(1) - covered[:, 0]) * (x[1] / math.sqrt(math.pi))
    factor = logsigmoid(logits) - integral.log()
    return (opacity.log() - passed).to(opacities.dtype), (scales.double() + factor[:, None]).to(scales.dtype)


def position_noise(scales: Tensor, quats: Tensor, opacities: Tensor) -> Tensor:
    """Random moves of N Gaussians, as long as they are wide, and the shorter the more opaque they are: covariance times
    normal numbers times the logistic function of 100 (0.005 - o) (the paper's equation 8).

    Args:
        scales: (N, 3) natural logarithms.
        quats: (N, 4) wxyz.
        opacities: (N, 1) logits.

    Returns:
        (N, 3), scene units.
    """
    normal = torch.randn(scales.shape[0], 3, 1, dtype=scales.dtype, device=scales.device)
    share = torch.sigmoid(100.0 * (0.005 - torch.sigmoid(opacities)))  # next to none from 0.05 on
    turn = rotation_matrices(quats)
    return share * (turn @ ((2 * scales).exp()[:, :, None] * (turn.mT @ normal)))[..., 0]


def drawn(weights: Tensor, count: int) -> Tensor:
    """Indices (count,) drawn in proportion to weights (N,), with replacement. ``torch.multinomial`` takes at most 2^24
    weights."""
    ends = weights.double().cumsum(0)
    chosen = torch.searchsorted(
        ends, torch.rand(count, dtype=torch.float64, device=weights.device) * ends[-1], right=True
    )
    return chosen.clamp(max=int(weights.nonzero()[-1]))  # where the product is rounded up to the last end


def next_count(num: int, most: int, later: int) -> int:
    """Number of Gaussians after a densification of ``num``, if ``later`` more follow until ``most`` has to be reached:
    the same factor for each, and at least the paper's."""
    if num >= most or later <= 0:
        return most
    return min(most, math.ceil(num * max(1.05, (most / num) ** (1 / (later + 1)))))


def replaced(
    optimizer: Optimizer, old: torch.nn.Parameter, new: Tensor, rows: Tensor, changed: Tensor
) -> torch.nn.Parameter:
    """A parameter of other Gaussians in place of an old one in its optimiser, whose averages follow them.

    Args:
        optimizer: of this parameter alone.
        old: (N, ...) parameter.
        new: (M, ...) values.
        rows: (M,) row of ``old`` that each comes from.
        changed: rows of ``new`` whose averages start anew.
    """
    parameter = torch.nn.Parameter(new)
    averages = optimizer.state.pop(old, {})
    for name, value in averages.items():
        if torch.is_tensor(value) and value.shape == old.shape:
            averages[name] = value[rows]
            averages[name][changed] = 0.0
    optimizer.param_groups[0]["params"] = [parameter]
    if averages:
        optimizer.state[parameter] = averages
    return parameter
