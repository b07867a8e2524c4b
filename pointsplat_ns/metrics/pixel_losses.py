"""Losses of the pixels of two images."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from torch import Tensor

PixelLoss = Literal["l1", "rmse"]
"""Mean absolute difference, or root mean squared difference, which determines the PSNR."""

PIXEL_LOSSES: dict[PixelLoss, Callable[[Tensor], Tensor]] = {
    "l1": lambda difference: difference.abs().mean(),
    # 1e-12 (120 dB) keeps the gradient of the root finite for identical images.
    "rmse": lambda difference: (difference.square().mean() + 1e-12).sqrt(),
}
"""Losses by name, as functions of the difference (H, W, 3) of two images."""
