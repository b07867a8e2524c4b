"""Image metrics: PSNR and SSIM of images in memory, LPIPS with weights from disk or torchvision."""

from pointsplat_ns.metrics.images import SSIM_WINDOW, ImageError, as_nchw, per_image, psnr, ssim

__all__ = ["SSIM_WINDOW", "ImageError", "as_nchw", "per_image", "psnr", "ssim"]
