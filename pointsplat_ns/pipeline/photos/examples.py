"""Pictures that are wanted of a scene: photos, or renders of another scene, with their views."""

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
    """A view and the image that is wanted there."""

    view: View
    target: Tensor  # [H, W, 3] in [0, 1]
    mask: Tensor | None = None  # [H, W, 1] bool, the pixels that count; None for all

    def __repr__(self) -> str:
        mask = "" if self.mask is None else ", masked"
        return f"{type(self).__name__}({self.view.width} x {self.view.height} pixels{mask})"

    def compared(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """An image of the view and the target on its device, both black where pixels do not
        count."""
        target = self.target.to(image)
        return (
            (image, target)
            if self.mask is None
            else (image * self.mask.to(image), target * self.mask.to(image))
        )

    def psnr(self, image: Tensor) -> float:
        """PSNR of an image of the view, over the pixels that count, dB; at most ``MOST_PSNR``."""
        image, target = self.compared(image.double())
        counted = 1.0 if self.mask is None else float(self.mask.double().mean())
        return min(psnr_of(float((image - target).square().mean()), counted), MOST_PSNR)


Photos = Sequence[Example]
"""Photos with the views that they show; read when they are asked for. Photos of uint8 count in
255ths."""


@torch.no_grad()
def mean_psnr(scene: Gaussians, photos: Photos, indices: list[int]) -> float:
    """Mean PSNR in some of the photos, dB, in every k-th of their pixels."""
    shown = (
        every_kth_pixel(photos[index], sides_of(*RESOLUTION)[1], scene.device) for index in indices
    )
    return fmean(photo.psnr(render(scene, photo.view)) for photo in shown)


@torch.no_grad()
def render_of(scene: Gaussians, view: View) -> Example:
    """A view, and what it shows of a scene."""
    return Example(view, render(scene, view))


def every_kth_pixel(
    photo: Example, side: int, device: torch.device, generator: random.Random | None = None
) -> Example:
    """Every k-th pixel of a photo along each axis, and the view that draws exactly these pixels.

    Args:
        photo: the whole photo.
        side: longer side that is wanted, pixels; k is the largest number that leaves at least as
            many.
        device: of the result.
        generator: draws the first column and row; by default the middle of k.
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
