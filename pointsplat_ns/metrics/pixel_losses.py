"""Pixel losses of two images, differentiable."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from torch import Tensor

from pointsplat_ns.metrics.images import as_nchw
from pointsplat_ns.system.threads import one_thread

PixelLoss = Literal["l1", "rmse"]
"""Mean absolute error, or root mean squared error, which determines the PSNR."""


def _l1(difference: Tensor) -> Tensor:
    return difference.abs().mean()


def _rmse(difference: Tensor) -> Tensor:
    with one_thread():  # the rounding of the sum, and so the gradient, depends on the thread count
        # 1e-12 (120 dB) keeps the gradient of the root finite for identical images.
        return (difference.square().mean() + 1e-12).sqrt()


PIXEL_LOSSES: dict[PixelLoss, Callable[[Tensor], Tensor]] = {
    "l1": _l1,
    "rmse": _rmse,
}
"""Losses by name, as functions of the difference (H, W, 3) of two images."""


def l1_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Mean absolute error: the pixel loss of the paper, to which it adds 0.1 times LPIPS with VGG
    (:func:`~pointsplat_ns.metrics.lpips.lpips`).

    Args:
        pred: (H, W, 3) or (B, H, W, 3), in [0, 1].
        target: the same shape.

    Returns:
        A scalar, the mean over all images.

    Raises:
        ImageError: if the images cannot be compared.

    Example:
        >>> import torch
        >>> import pointsplat_ns as ps
        >>> image = torch.full((4, 4, 3), 0.75, requires_grad=True)
        >>> ps.l1_loss(image, torch.full((4, 4, 3), 0.5)).item()
        0.25
    """
    as_nchw(pred, target)  # checks them
    return _l1(pred - target)


def rmse_loss(pred: Tensor, target: Tensor) -> Tensor:
    """Root mean squared error, which determines the PSNR: its logarithm falls as the PSNR rises.

    Args:
        pred: (H, W, 3) or (B, H, W, 3), in [0, 1].
        target: the same shape.

    Returns:
        A scalar, the root of the mean over all images; at least 1e-6.

    Raises:
        ImageError: if the images cannot be compared.

    Example:
        >>> import torch
        >>> import pointsplat_ns as ps
        >>> loss = ps.rmse_loss(torch.full((4, 4, 3), 0.75), torch.full((4, 4, 3), 0.5))
        >>> round(loss.item(), 4)
        0.25
    """
    as_nchw(pred, target)  # checks them
    return _rmse(pred - target)
