"""Pixel losses of two images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from torch import Tensor

from pointsplat_ns.system.threads import one_thread

PixelLoss = Literal["l1", "rmse"]
"""Mean absolute error, or root mean squared error, which determines the PSNR."""


def _rmse(difference: Tensor) -> Tensor:
    with one_thread():  # the rounding of the sum, and so the gradient, depends on the thread count
        # 1e-12 (120 dB) keeps the gradient of the root finite for identical images.
        return (difference.square().mean() + 1e-12).sqrt()


PIXEL_LOSSES: dict[PixelLoss, Callable[[Tensor], Tensor]] = {
    "l1": lambda difference: difference.abs().mean(),
    "rmse": _rmse,
}
"""Losses by name, as functions of the difference (H, W, 3) of two images."""
