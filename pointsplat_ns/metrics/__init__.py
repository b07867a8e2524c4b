"""Image metrics: PSNR and SSIM of images in memory, LPIPS with weights from disk or torchvision."""

from pointsplat_ns.metrics.images import ImageError, as_nchw, per_image, psnr, ssim
from pointsplat_ns.metrics.structural_similarity import SSIM_WINDOW

__all__ = ["SSIM_WINDOW", "ImageError", "as_nchw", "per_image", "psnr", "ssim"]
