"""Target images with their views: photos, or renders of another scene."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import replace
from statistics import fmean
from typing import NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.metrics import MOST_PSNR, psnr_of
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.sizes import RESOLUTION, sides_of
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import in_unit_range
from pointsplat_ns.scene.views import View


class Example(NamedTuple):
    """A view and its target image."""

    view: View
    target: Tensor  # [H, W, 3] in [0, 1]
    mask: Tensor | None = None  # [H, W, 1] bool, True for valid pixels; None for all

    def compared(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """An image of the view, and the target on its device, both black on masked pixels."""
        target = self.target.to(image)
        if self.mask is None:
            return image, target
        mask = self.mask.to(image)
        return image * mask, target * mask

    def psnr(self, image: Tensor) -> float:
        """PSNR of an image of the view over valid pixels, dB; at most ``MOST_PSNR``."""
        image, target = self.compared(image.double())
        counted = 1.0 if self.mask is None else float(self.mask.double().mean())
        return min(psnr_of(float((image - target).square().mean()), counted), MOST_PSNR)


Photos = Sequence[Example]
"""Photos with their views, read lazily. Photos are in [0, 1], or uint8."""


@torch.no_grad()
def mean_psnr(scene: Gaussians, photos: Photos, indices: list[int]) -> float:
    """Mean PSNR over every k-th pixel of the photos at ``indices``, dB."""
    side = sides_of(*RESOLUTION)[1]
    shown = (every_kth_pixel(photos[index], side, scene.device) for index in indices)
    return fmean(photo.psnr(render(scene, photo.view)) for photo in shown)


@torch.no_grad()
def render_of(scene: Gaussians, view: View) -> Example:
    """A view, and its render of a scene as the target."""
    return Example(view, render(scene, view))


def every_kth_pixel(
    photo: Example, side: int, device: torch.device, generator: random.Random | None = None
) -> Example:
    """Every k-th pixel of a photo along both axes, and the view of exactly these pixels.

    Args:
        photo: the whole photo.
        side: minimum longer side of the result, pixels; k is the largest factor that leaves as
            many.
        device: device of the result.
        generator: draws the first column and row; by default k // 2.
    """
    view = photo.view
    k = max(1, max(view.width, view.height) // side)
    left, top = (k // 2 if generator is None else generator.randrange(k) for _ in range(2))
    image = in_unit_range(photo.target[top::k, left::k].to(device))
    mask = None if photo.mask is None else photo.mask[top::k, left::k].to(device)
    K = view.K.clone()
    K[:2, 2] = (K[:2, 2] - K.new_tensor([left + 0.5, top + 0.5])) / k + 0.5
    K[0, :2] /= k
    K[1, 1] /= k
    height, width = image.shape[:2]
    return Example(
        replace(view, K=K, width=width, height=height, eps2d=view.eps2d / k**2), image, mask
    )
