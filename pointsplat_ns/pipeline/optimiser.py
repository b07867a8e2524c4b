"""Optimises a scene with Adam, so that its renders match target images.

The loss of a view is 0.8 RMSE + 0.2 (1 - SSIM). L1 in place of the root mean square error, as in
3DGS, loses 0.16 dB in held-out photos at equal LPIPS for a tenth trained on photos (fox, figure,
ray, drone_hall), and 0.09 dB for a repair (three splats at 3 to 50 %).
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import Literal

import torch
from torch import Tensor

from pointsplat_ns.metrics import PIXEL_LOSSES, SSIM_WINDOW, PixelLoss
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.pipeline.photos.examples import Example
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import View
from pointsplat_ns.system.kernels import (
    FLOAT_POINTER,
    INT64_POINTER,
    KERNELS,
    SEVERAL,
    Function,
    Struct,
    c_fields,
    on_threads,
)
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.system.threads import most_threads, one_thread, one_thread_each, parallel_map


class AdamStepStruct(Struct):
    """``AdamStep`` of ``optimiser.cpp``, which documents its members."""

    members = {
        "values": FLOAT_POINTER,
        "gradient": FLOAT_POINTER,
        "first": FLOAT_POINTER,
        "second": FLOAT_POINTER,
        "moved": FLOAT_POINTER,
        "factors": FLOAT_POINTER,
        "count": ctypes.c_int64,
        "columns": ctypes.c_int64,
        "kind": ctypes.c_int64,
        "kinds": ctypes.c_int64,
        "rate": ctypes.c_float,
        "epsilon": ctypes.c_float,
        "fresh": ctypes.c_float,
        "kept_square": ctypes.c_float,
        "fresh_square": ctypes.c_float,
        "weight_sum": ctypes.c_float,
        "square_weight_sum": ctypes.c_float,
    }
    _fields_ = c_fields(members)


adam_kernel = Function("pointsplat_adam", AdamStepStruct, INT64_POINTER)

RATES = {
    # times the extent of the scene: the final rate of 3DGS, as the scene has been trained
    "means": 1.6e-6,
    "scales": 5e-3,
    "quats": 1e-3,
    "opacities": 2.5e-2,
    "features_dc": 2.5e-3,
    "features_rest": 2.5e-3 / 20,
}
"""Learning rates by parameter, as in 3DGS."""


Choose = Callable[[Gaussians], tuple[float, Tensor | None]]
"""Returns ``share`` and ``factors`` of :meth:`Adam.moves` for the scene before a step."""

VIEWS_AT_ONCE = 2
"""Number of views whose gradients are computed in parallel from one scene; a step per view follows.
Two views cost nothing in held-out photos (fox, vr_project), and 0.01 to 0.05 dB in a repair (three
splats at 3 to 50 %). Four cost a repair up to 0.16 dB."""


@dataclass(frozen=True)
class AdamSettings:
    """Settings of Adam."""

    faster: float = 1.0
    """Factor on the learning rates."""
    betas: tuple[float, float] = (0.9, 0.999)
    """Decays of the averages of the gradient and of its square."""
    damping: float = 0.0
    """Adam's epsilon of each parameter, as a share of the root mean square of its first nonzero
    gradients. 0 means an epsilon of 1e-15."""


class Adam:
    """Adam for the parameters of a scene: averages of gradients, and the resulting steps.

    Args:
        scene: K Gaussians before the first step.
        settings: decays and damping.
        rates: learning rates by parameter name; the rate of the means is multiplied by the extent
            of the scene.
    """

    def __init__(
        self, scene: Gaussians, settings: AdamSettings, rates: Mapping[str, float] = RATES
    ):
        self.reach = extent(scene)
        """Extent of the scene at the start, scene units."""
        self.rates = {
            name: settings.faster * rates[name] * (self.reach if name == "means" else 1.0)
            for name in RATES
        }
        self._settings = settings
        self._first = {name: value.new_zeros(value.shape) for name, value in scene.items()}
        self._second = {name: value.new_zeros(value.shape) for name, value in scene.items()}
        self._damping = dict.fromkeys(RATES, 0.0)
        self._directions: dict[str, Tensor] = {}
        self._steps = 0

    @torch.no_grad()
    def observe(self, gradients: dict[str, Tensor]) -> None:
        """Update the averages with the gradients of one view's loss, by parameter; all finite."""
        self._steps += 1
        beta, square_beta = self._settings.betas
        for name in RATES:
            gradient = gradients[name]
            self._damp(name, gradient)
            self._first[name].lerp_(gradient, 1 - beta)
            self._second[name].mul_(square_beta).addcmul_(gradient, gradient, value=1 - square_beta)
            root = (self._second[name] / self._weight_sum(1)).sqrt_()
            self._directions[name] = (self._first[name] / self._weight_sum(0)).div_(
                root.add_(self._epsilon(name))
            )

    def moves(self, share: float, factors: Tensor | None = None) -> dict[str, Tensor]:
        """The step of each parameter: Adam's step times factors.

        Args:
            share: factor on all learning rates.
            factors: (K, 6), a factor per Gaussian and parameter; None means 1.
        """
        moves = {}
        for kind, name in enumerate(RATES):
            step = self._directions[name]
            if factors is not None:
                step = step * factors[:, kind].to(step).view(-1, *[1] * (step.dim() - 1))
            moves[name] = step * (-share * self.rates[name])
        return moves

    def moved(
        self, scene: Gaussians, share: float = 1.0, factors: Tensor | None = None
    ) -> Gaussians:
        """The scene after a step; arguments as for :meth:`moves`."""
        moves = self.moves(share, factors)
        return scene.replace(**{name: value + moves[name] for name, value in scene.items()})

    @torch.no_grad()
    def stepped(self, scene: Gaussians, gradients: dict[str, Tensor], choose: Choose) -> Gaussians:
        """The scene after :meth:`observe` and :meth:`moved` with the result of ``choose``; in one
        pass where the compiled kernel is available."""
        share, factors = choose(scene)
        if not KERNELS.usable_for(None, *scene.tensors()):
            self.observe(gradients)
            return self.moved(scene, share, factors)
        self._steps += 1
        factors = None if factors is None else factors.to(scene.means).contiguous()
        moved = {name: value.new_empty(value.shape) for name, value in scene.items()}
        beta, square_beta = self._settings.betas
        for kind, (name, values) in enumerate(scene.items()):
            self._damp(name, gradients[name])
            task = AdamStepStruct(
                values=values.contiguous(),
                gradient=gradients[name].contiguous(),
                first=self._first[name],
                second=self._second[name],
                moved=moved[name],
                factors=factors,
                count=len(values),
                columns=values[:1].numel(),
                kind=kind,
                kinds=len(RATES),
                rate=share * self.rates[name],
                epsilon=self._epsilon(name),
                fresh=1 - beta,
                kept_square=square_beta,
                fresh_square=1 - square_beta,
                weight_sum=self._weight_sum(0),
                square_weight_sum=self._weight_sum(1),
            )
            on_threads(len(values) >= SEVERAL, adam_kernel, task)
        return scene.replace(**moved)

    def state(self) -> dict[str, Tensor]:
        """State of the optimiser by name: the averages (not copies) and the damping."""
        averages = {"first": self._first, "second": self._second}
        state = {
            f"{which}.{name}": value
            for which, kind in averages.items()
            for name, value in kind.items()
        }
        return {**state, "damping": torch.tensor([*self._damping.values()], **DOUBLES)}

    def restore(self, state: Mapping[str, Tensor], steps: int) -> None:
        """Restore the state after ``steps`` steps, from tensors with the shapes of
        :meth:`state`."""
        self._steps = steps
        self._damping = dict(zip(RATES, state["damping"].tolist(), strict=True))
        for name, value in self.state().items():
            value.copy_(state[name])

    def root_mean_square(self, name: str) -> Tensor:
        """Root mean square of a parameter's gradients so far, (K,): averaged over steps, summed
        over components."""
        return (self._second[name] / self._weight_sum(1)).flatten(1).sum(1).sqrt()

    def _weight_sum(self, which: int) -> float:
        """Sum of the weights in an average, for bias correction; ``which`` indexes ``betas``."""
        return 1 - self._settings.betas[which] ** self._steps

    def _damp(self, name: str, gradient: Tensor) -> None:
        if self._settings.damping:
            damping = self._settings.damping
            self._damping[name] = self._damping[name] or damping * nonzero_rms(gradient)

    def _epsilon(self, name: str) -> float:
        return max(self._damping[name], 1e-15)


def optimised(
    scene: Gaussians,
    adam: Adam,
    examples: Iterator[Callable[[], Example]],
    choose: Choose = lambda scene: (1.0, None),
    pixel_loss: PixelLoss = "rmse",
    together: int = VIEWS_AT_ONCE,
) -> Iterator[Gaussians]:
    """Yield the scene after each step, endlessly. Values that are not finite (the logit of opacity
    1, the log-scale of a flat axis) do not change.

    Args:
        scene: K Gaussians; not changed.
        adam: optimiser, made from the same scene.
        examples: endless functions that make a view and its target image, on any thread.
        choose: sets the length of a step; called after its gradients are computed.
        pixel_loss: "l1" for the loss of 3DGS.
        together: number of steps that share the scene from which gradients are computed.
    """
    last = scene.detach()

    def gradients(example: Callable[[], Example]) -> dict[str, Tensor]:
        return gradients_of(last, *example(), pixel_loss=pixel_loss)

    while True:
        with one_thread_each():
            inside = max(1, most_threads() // together)
            batch = [*parallel_map(gradients, [*islice(examples, together)], scene.device, inside)]
        for view_gradients in batch:
            with one_thread_each():
                last = adam.stepped(last, view_gradients, choose)
            yield last


def extent(scene: Gaussians) -> float:
    """The 90 % quantile of distances from the per-axis median position, scene units; 1 if all
    Gaussians are in one place. Unlike a mean, it is not changed by one distant Gaussian."""
    means = scene.means.detach().double()
    with one_thread():
        return float((means - means.median(0).values).norm(dim=1).quantile(0.9)) or 1.0


@torch.no_grad()
def size_factors(scene: Gaussians, reach: float) -> Tensor:
    """Factors for :meth:`Adam.moves` that make the rate of the means a share of each Gaussian's
    middle standard deviation. Other rates stay.

    Args:
        scene: K Gaussians.
        reach: extent of the scene when ``Adam`` was made, scene units; larger sizes are clamped to
            it.

    Returns:
        (K, 6).
    """
    factors = scene.means.new_ones(len(scene), len(RATES))
    a, b, c = scene.scales.unbind(1)
    log_reach = math.log(reach)
    middle = torch.maximum(torch.minimum(a, b), torch.minimum(torch.maximum(a, b), c))
    sizes = (middle.clamp(max=log_reach) - log_reach).exp()
    factors[:, list(RATES).index("means")] = sizes.nan_to_num(0.0)
    return factors


def gradients_of(
    scene: Gaussians,
    view: View,
    target: Tensor,
    mask: Tensor | None = None,
    backend: Literal["torch", "auto"] = "torch",
    pixel_loss: PixelLoss = "rmse",
) -> dict[str, Tensor]:
    """Gradients of one view's loss, by parameter. A gradient is 0 where it or its value is not
    finite.

    Args:
        scene: K Gaussians.
        view: the camera.
        target: (H, W, 3) target image in [0, 1].
        mask: (H, W, 1) bool, pixels of the loss; None for all.
        backend: the rasterizer, as for :func:`pointsplat_ns.rendering.render`.
        pixel_loss: as for :func:`optimised`.
    """
    leaves = scene.map(lambda value: value.detach().requires_grad_())
    with torch.enable_grad():
        image = render(leaves, view, backend=backend)
        _loss(*Example(view, target, mask).compared(image), pixel_loss).backward()
    gradients = {
        name: torch.zeros_like(value) if value.grad is None else value.grad
        for name, value in leaves.items()
    }
    # Nearly always, all values are finite, and so are their sums. A sum takes a tenth of the time
    # of an elementwise check.
    sums = torch.stack([value.detach().sum() for value in (*leaves.tensors(), *gradients.values())])
    if not bool(sums.isfinite().all()):
        for name, value in leaves.items():
            gradients[name].nan_to_num_(0.0, 0.0, 0.0).masked_fill_(~value.detach().isfinite(), 0.0)
    return gradients


def nonzero_rms(gradient: Tensor) -> float:
    """Root mean square of the nonzero gradients, in float64; 0 if there are none."""
    nonzero = gradient[gradient != 0].double()
    with one_thread():
        return float(nonzero.square().mean().sqrt()) if nonzero.numel() else 0.0


def _loss(image: Tensor, target: Tensor, pixel_loss: PixelLoss) -> Tensor:
    """The loss of an image (H, W, 3); without SSIM for images smaller than its window."""
    pixels = PIXEL_LOSSES[pixel_loss](image - target)
    if min(image.shape[:2]) < SSIM_WINDOW:
        return pixels
    similarity = mean_ssim(image.permute(2, 0, 1)[None], target.permute(2, 0, 1)[None])
    return 0.8 * pixels + 0.2 * (1 - similarity)
