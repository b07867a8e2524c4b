"""Image metrics: PSNR and SSIM of images in memory, LPIPS with weights from disk or torchvision."""

from pointsplat_ns.metrics.images import (
    MOST_PSNR,
    ImageError,
    as_nchw,
    finite_psnr,
    per_image,
    psnr,
    psnr_of,
    ssim,
)
from pointsplat_ns.metrics.pixel_losses import PIXEL_LOSSES, PixelLoss, l1_loss, rmse_loss
from pointsplat_ns.metrics.structural_similarity import SSIM_WINDOW

__all__ = [
    "MOST_PSNR",
    "PIXEL_LOSSES",
    "SSIM_WINDOW",
    "ImageError",
    "PixelLoss",
    "as_nchw",
    "finite_psnr",
    "l1_loss",
    "per_image",
    "psnr",
    "psnr_of",
    "rmse_loss",
    "ssim",
]
