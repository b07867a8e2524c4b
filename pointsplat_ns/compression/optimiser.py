"""One step of Adam at a time on the parameters of a scene, so that its renders match target images."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.metrics import SSIM_WINDOW
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.rasterizer import render
from pointsplat_ns.system.threads import one_thread
from pointsplat_ns.views import View

RATES = {
    "means": 1.6e-6,  # times the extent of the scene: the final rate of 3DGS, as the scene has been trained
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 2.5e-2,
    "features_dc": 2.5e-3,
    "features_rest": 2.5e-3 / 20,
}
"""Learning rates of Adam, as in 3DGS."""

SSIM_WEIGHT = 0.2
"""Weight of 1 - SSIM in the loss, as in 3DGS; L1 has the rest."""


class Optimiser:
    """Adam on 0.8 L1 + 0.2 (1 - SSIM), one view a step. The number of Gaussians does not change.

    Values that are not finite (the logit of opacity 1, the log-scale of a flat axis) do not change. A gradient that is
    not finite counts as 0.

    Args:
        scene: K Gaussians; they are copied.
        rates: learning rates by parameter name; that of the means is multiplied by the extent of the scene.
    """

    def __init__(self, scene: Gaussians, rates: dict[str, float]):
        reach = extent(scene)
        self._scene = scene.map(lambda value: value.detach().clone())
        groups = [
            {"params": [value], "lr": rates[name] * (reach if name == "means" else 1.0)}
            for name, value in self._scene.items()
            if value.numel()
        ]
        self._adam = torch.optim.Adam(groups, eps=1e-15, fused=True)

    @property
    def scene(self) -> Gaussians:
        """The scene as it is now."""
        return self._scene.map(torch.clone)

    def step(self, view: View, target: Tensor) -> None:
        """Take one step.

        Args:
            view: what is rendered.
            target: (H, W, 3) image that it should look like, in [0, 1].
        """
        gradients = gradients_of(self._scene, view, target)
        for name, value in self._scene.items():
            value.grad = gradients[name]
        self._adam.step()


def extent(scene: Gaussians) -> float:
    """How far the Gaussians of a scene reach from their mean position, but for the farthest tenth, scene units; 1 if
    they are all in one place."""
    with one_thread():
        centred = scene.means.detach().double() - scene.means.detach().double().mean(0)
        return float(centred.norm(dim=1).quantile(0.9)) or 1.0


def gradients_of(
    scene: Gaussians, view: View, target: Tensor, backend: Literal["torch", "auto"] = "torch"
) -> dict[str, Tensor]:
    """Gradients of the loss of one view by parameter. What is not finite is 0, and so are the gradients of values that
    are not finite themselves.

    Args:
        scene: K Gaussians.
        view: what is rendered.
        target: (H, W, 3) image that it should look like, in [0, 1].
        backend: what draws, as for :func:`pointsplat_ns.rasterizer.render`.
    """
    leaves = scene.map(lambda value: value.detach().requires_grad_())
    with torch.enable_grad():
        _loss(render(leaves, view, backend=backend), target).backward()
    return {name: _finite_gradient(value) for name, value in leaves.items()}


def _finite_gradient(value: Tensor) -> Tensor:
    if value.grad is None:
        return torch.zeros_like(value)
    return value.grad.nan_to_num_(0.0, 0.0, 0.0).masked_fill_(~value.detach().isfinite(), 0.0)


def seen_rms(gradient: Tensor) -> float:
    """Root mean square of the gradients that are not 0, in float64; 0 if all are."""
    seen = gradient[gradient != 0].double()
    with one_thread():
        return float(seen.square().mean().sqrt()) if seen.numel() else 0.0


def _loss(image: Tensor, target: Tensor) -> Tensor:
    l1 = (image - target).abs().mean()
    if min(image.shape[:2]) < SSIM_WINDOW:
        return l1
    similarity = mean_ssim(image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - similarity)
