"""One step of Adam at a time on the parameters of a scene, so that its renders match target images."""

from __future__ import annotations

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.metrics import SSIM_WINDOW
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.rasterizer import render
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
        betas: decay of Adam's averages of the gradient and of its square.
        damping: Adam's epsilon, as a share of the root mean square of a parameter's gradient, over what is seen in the
            first step. Adam moves all Gaussians equally far, also those that are right already and whose gradients are
            next to nothing; what is damped moves less.
    """

    def __init__(
        self,
        scene: Gaussians,
        rates: dict[str, float],
        betas: tuple[float, float] = (0.9, 0.999),
        damping: float = 0.0,
    ):
        centred = scene.means.detach().double() - scene.means.detach().double().mean(0)
        extent = float(centred.norm(dim=1).quantile(0.9)) or 1.0
        self._parameters = {name: value.detach().clone().requires_grad_() for name, value in scene.items()}
        self._fixed = {name: ~value.detach().isfinite() for name, value in self._parameters.items()}
        groups = []
        for name, value in self._parameters.items():
            rate = rates[name] * (extent if name == "means" else 1.0)
            if value.numel():
                groups.append({"params": [value], "lr": rate, "peak": rate})
        self._damping = damping
        self._adam = torch.optim.Adam(groups, betas=betas, eps=1e-15, fused=True)

    @property
    def scene(self) -> Gaussians:
        """The scene as it is now."""
        return Gaussians(**{name: value.detach().clone() for name, value in self._parameters.items()})

    def step(self, view: View, target: Tensor, share: float = 1.0) -> None:
        """Take one step.

        Args:
            view: what is rendered.
            target: (H, W, 3) image that it should look like, in [0, 1].
            share: of the learning rates.
        """
        self._adam.zero_grad()
        _loss(render(Gaussians(**self._parameters), view), target).backward()
        for name, value in self._parameters.items():
            if value.grad is not None:
                value.grad.nan_to_num_(0.0, 0.0, 0.0)[self._fixed[name]] = 0.0
        for group in self._adam.param_groups:
            group["lr"] = share * group["peak"]
            if self._damping and "damped" not in group:
                group["eps"], group["damped"] = max(1e-15, self._damping * seen_rms(group["params"][0].grad)), True
        self._adam.step()


def seen_rms(gradient: Tensor | None) -> float:
    """Root mean square of the gradients that are not 0, in float64; 0 if all are."""
    if gradient is None:
        return 0.0
    seen = gradient[gradient != 0].double()
    return float(seen.square().mean().sqrt()) if seen.numel() else 0.0


def _loss(image: Tensor, target: Tensor) -> Tensor:
    l1 = (image - target).abs().mean()
    if min(image.shape[:2]) < SSIM_WINDOW:
        return l1
    similarity = mean_ssim(image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
    return (1 - SSIM_WEIGHT) * l1 + SSIM_WEIGHT * (1 - similarity)
