"""Image metrics: PSNR and SSIM (LPIPS is in :mod:`pointsplat_ns.metrics.lpips`).

Images are (H, W, 3) or (B, H, W, 3), in [0, 1]; values are not clamped. Each metric returns a
scalar for one image and (B,) for a batch, one value per image.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics.structural_similarity import SSIM_WINDOW


class ImageError(PointSplatError, ValueError):
    """Images that cannot be compared."""


def as_nchw(pred: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Both images as (B, 3, H, W), with B = 1 for single images. Raises ImageError if their shapes
    differ or are not (H, W, 3) or (B, H, W, 3), if they have no pixels, or if a dtype is not
    floating-point."""
    for name, image in (("pred", pred), ("target", target)):
        if image.dim() not in (3, 4) or image.shape[-1] != 3 or image.numel() == 0:
            raise ImageError(
                f"{name} has shape {tuple(image.shape)}; expected (H, W, 3) or (B, H, W, 3)"
            )
        if not image.is_floating_point():
            raise ImageError(f"{name} is {image.dtype}; expected a floating-point image in [0, 1]")
    if pred.shape != target.shape:
        raise ImageError(
            f"pred has shape {tuple(pred.shape)} but target {tuple(target.shape)}; expected the "
            "same"
        )
    if pred.dim() == 3:
        pred = pred[None]
        target = target[None]
    return pred.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2)


def per_image(values: Tensor, like: Tensor) -> Tensor:
    """``values`` (B,) as a scalar if ``like`` is a single image."""
    return values[0] if like.dim() == 3 else values


def psnr(pred: Tensor, target: Tensor) -> Tensor:
    """Peak signal-to-noise ratio in dB, ``-10 log10(mean squared error)``, data range 1.

    Identical images give ``inf``.

    Args:
        pred: (H, W, 3) or (B, H, W, 3), in [0, 1].
        target: the same shape.

    Returns:
        A scalar, or (B,).

    Raises:
        ImageError: if the images cannot be compared.

    Example:
        >>> round(float(psnr(torch.full((4, 4, 3), 0.6), torch.full((4, 4, 3), 0.5))), 3)
        20.0
    """
    a, b = as_nchw(pred, target)
    return per_image(-10 * torch.log10((a - b).square().mean(dim=(1, 2, 3))), pred)


def psnr_of(error: float, covered: float = 1.0) -> float:
    """PSNR over the pixels that a scene covers, dB: the sum of all squared errors, including halos
    beside the scene, divided by the share of covered pixels. Empty background does not improve it.

    ``error`` is the mean squared error over all pixels, data range 1. If the share ``covered``, in
    [0, 1], is 0, all pixels count. Returns inf for zero error, and NaN for NaN.

    Example:
        >>> psnr_of(0.001), psnr_of(0.001, covered=0.1)
        (30.0, 20.0)
    """
    if error == 0:
        return math.inf
    return -10 * (math.log10(error) - math.log10(covered or 1.0)) if error > 0 else math.nan


MOST_PSNR = 100.0
"""Replaces the infinite PSNR of equal images, so that means over views stay finite."""


def finite_psnr(pred: Tensor, target: Tensor) -> float:
    """PSNR of one image (H, W, 3), dB, at most :data:`MOST_PSNR`."""
    return min(float(psnr(pred, target)), MOST_PSNR)


def ssim(pred: Tensor, target: Tensor) -> Tensor:
    """Structural similarity (Wang et al. 2004), data range 1.

    11 x 11 Gaussian window of sigma 1.5, population moments, averaged over the channels and over
    the pixels whose whole window is inside the image, as in the original publication.
    pytorch-msssim, and so Splatfacto, computes the same. Other libraries pad the image and include
    the border: torchmetrics by reflection, the original 3DGS code with zeros. Their values differ
    slightly and should not be compared with these.

    Args:
        pred: (H, W, 3) or (B, H, W, 3), in [0, 1], at least 11 pixels a side.
        target: the same shape.

    Returns:
        A scalar, or (B,), in [-1, 1]; 1 for identical images. Differentiable.

    Raises:
        ImageError: if the images cannot be compared or are smaller than the window.

    Example:
        >>> image = torch.linspace(0, 1, 16 * 16 * 3).reshape(16, 16, 3)
        >>> round(float(ssim(image, image)), 3), float(ssim(image, 1 - image)) < 0
        (1.0, True)
    """
    import kornia.metrics

    a, b = as_nchw(pred, target)
    if min(a.shape[2:]) < SSIM_WINDOW:
        raise ImageError(
            f"images of {a.shape[3]} x {a.shape[2]} pixels are smaller than SSIM's window; "
            f"expected at least {SSIM_WINDOW} x {SSIM_WINDOW}"
        )
    # eps=0, because the definition's two constants already keep the denominator positive.
    values = kornia.metrics.ssim(
        a.contiguous(), b.contiguous(), SSIM_WINDOW, max_val=1.0, eps=0.0, padding="valid"
    )
    return per_image(values.mean(dim=(1, 2, 3)), pred)
