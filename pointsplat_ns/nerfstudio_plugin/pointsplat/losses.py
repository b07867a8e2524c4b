"""The training loss of the refiner, between renders and photos."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.metrics import ImageError
from pointsplat_ns.metrics.lpips import Lpips, LpipsUnavailable, cached_lpips

PIXEL_LOSSES: dict[str, Callable[[Tensor], Tensor]] = {
    "l1": lambda difference: difference.abs().mean(),
    # 1e-12 (120 dB) keeps the gradient of the root finite for identical images.
    "rmse": lambda difference: (difference.square().mean() + 1e-12).sqrt(),
}
"""Pixel losses by name, as functions of the difference (H, W, 3) of two images."""


class PhotoLoss:
    """A pixel loss, one of :data:`PIXEL_LOSSES`, plus weighted LPIPS. If LPIPS cannot be computed, the pixel loss
    alone. The network "auto" is VGG on CUDA and AlexNet elsewhere."""

    def __init__(self, pixel_loss: str, lpips_weight: float, lpips_net: Literal["auto", "alex", "vgg"]):
        self._pixel_loss, self._weight, self._net = pixel_loss, lpips_weight, lpips_net
        self.no_lpips_reason: str | None = None
        """Why LPIPS is left out of the loss; None while it is part of it."""

    def __call__(self, pairs: list[tuple[Tensor, Tensor]]) -> dict[str, Tensor]:
        """The terms of the loss, which is their sum, by name: the pixel loss and the weighted ``lpips``, as means over
        pairs of renders and photos, each (H, W, 3) in [0, 1]."""
        pixel_loss = PIXEL_LOSSES[self._pixel_loss]
        losses = {self._pixel_loss: torch.stack([pixel_loss(render - photo) for render, photo in pairs]).mean()}
        distances: list[Tensor] = []
        for render, photo in pairs:
            lpips = self._lpips(render.device)
            if lpips is None:
                break
            try:
                distances.append(lpips(render, photo))
            except ImageError as error:  # too small for the network
                self._leave_out_lpips(error)
        if distances:
            losses["lpips"] = self._weight * torch.stack(distances).mean()
        return losses

    def _lpips(self, device: torch.device) -> Lpips | None:
        """LPIPS; None if its weight is 0 or it could not be computed before. After a failure it stays left out, so that
        the loss does not change back during training."""
        if self._weight == 0 or self.no_lpips_reason is not None:
            return None
        net: Literal["alex", "vgg"]
        net = ("vgg" if device.type == "cuda" else "alex") if self._net == "auto" else self._net
        try:
            return cached_lpips(net, device)
        except LpipsUnavailable as error:
            self._leave_out_lpips(error)
            return None

    def _leave_out_lpips(self, error: LpipsUnavailable | ImageError) -> None:
        self.no_lpips_reason = str(error)
        CONSOLE.log(f"going on without LPIPS in the loss: {error}")
