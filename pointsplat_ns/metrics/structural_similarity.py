"""A fast SSIM for training losses.

It is defined as in pytorch-msssim, which Splatfacto uses, and in :func:`pointsplat_ns.ssim`, which uses kornia. Both
blur the five maps one after the other; blurring them together takes about half the time on a CPU. Tests check that all
three agree.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

SSIM_WINDOW = 11
"""Side of SSIM's Gaussian window in pixels."""

SIGMA = 1.5
"""Standard deviation of the window, in pixels."""

C1, C2 = 0.01**2, 0.03**2
"""The two constants of Wang et al. 2004 for a data range of 1."""


def mean_ssim(image: Tensor, other: Tensor) -> Tensor:
    """Mean structural similarity (Wang et al. 2004, eq. 13) of two images.

    An 11 x 11 Gaussian window of sigma 1.5, population moments, and only pixels whose window lies inside the image. A
    side shorter than the window is not blurred along, as in pytorch-msssim.

    Args:
        image: (B, C, H, W), in [0, 1].
        other: the same shape.

    Returns:
        A scalar in [-1, 1]; 1 for identical images. Differentiable.
    """
    maps = torch.cat([image, other, image * image, other * other, image * other], dim=1)
    mean, other_mean, square, other_square, product = _blur(maps).chunk(5, dim=1)
    mean_product, mean_square, other_mean_square = mean * other_mean, mean * mean, other_mean * other_mean
    contrast = (2 * (product - mean_product) + C2) / (square - mean_square + other_square - other_mean_square + C2)
    luminance = (2 * mean_product + C1) / (mean_square + other_mean_square + C1)
    return (luminance * contrast).mean()


def _blur(maps: Tensor) -> Tensor:
    """Gaussian blur of (B, K, H, W) where the whole window fits: (B, K, H - 10, W - 10)."""
    channels = maps.shape[1]
    offset = torch.arange(SSIM_WINDOW, dtype=maps.dtype, device=maps.device) - SSIM_WINDOW // 2
    weight = torch.exp(-offset.square() / (2 * SIGMA**2))
    weight = (weight / weight.sum()).repeat(channels, 1, 1, 1)  # (K, 1, 1, 11)
    if maps.shape[3] >= SSIM_WINDOW:
        maps = F.conv2d(maps, weight, groups=channels)
    if maps.shape[2] >= SSIM_WINDOW:
        maps = F.conv2d(maps, weight.transpose(2, 3), groups=channels)
    return maps
