"""Compares renders of a smaller scene with renders of the dense scene. No photos are needed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.windows import covered_share, mean_square
from pointsplat_ns.metrics import SSIM_WINDOW, ssim
from pointsplat_ns.rasterizer import render, render_with_alpha
from pointsplat_ns.views import Views


@dataclass(frozen=True)
class Closeness:
    """Errors of a scene's renders against those of the dense scene."""

    errors: tuple[float, ...]
    """Mean squared error of each view."""
    ssim: float | None
    """Mean over views; None if views are smaller than SSIM's window."""
    width: int | None = None
    """Width of the pictures, pixels; None if it is not known."""

    @property
    def where(self) -> str:
        """Text: the number of views, and their width."""
        return views_text(len(self.errors)) + ("" if self.width is None else f" of {self.width} pixels")

    @property
    def error(self) -> float:
        """Mean squared error over all pixels of all views."""
        return sum(self.errors) / len(self.errors)

    @property
    def psnr(self) -> float:
        """PSNR over all pixels of all views, dB; inf if nothing differs."""
        return _psnr(self.error)

    @property
    def worst(self) -> float:
        """PSNR of the worst view, dB."""
        return _psnr(max(self.errors))


class DenseReference:
    """Renders of the dense scene, for comparison with other scenes.

    Args:
        dense: the dense scene.
        views: views to render.
    """

    @torch.no_grad()
    def __init__(self, dense: Gaussians, views: Views):
        self.views = views
        drawn = [render_with_alpha(dense, view) for view in views]
        self.renders: list[Tensor] = [image for image, _ in drawn]
        self.covered = covered_share([alpha for _, alpha in drawn])
        """Share of all pixels that the dense scene covers, in [0, 1]."""

    @torch.no_grad()
    def errors(self, scene: Gaussians) -> list[float]:
        """Mean squared error of each view."""
        pairs = zip(self.views, self.renders, strict=True)
        return [mean_square(render(scene, view).double() - target.double()) for view, target in pairs]

    @torch.no_grad()
    def closeness(self, scene: Gaussians, progress: Callable[[float], None] | None = None) -> Closeness:
        """Errors and SSIM of a scene; ``progress`` is called with the share of the views done."""
        large_enough = min(self.views.width, self.views.height) >= SSIM_WINDOW
        errors, similarities = [], []
        for index, target in enumerate(self.renders):
            image = render(scene, self.views[index])
            errors.append(mean_square(image.double() - target.double()))
            if large_enough:
                similarities.append(float(ssim(image, target)))
            if progress is not None:
                progress((index + 1) / len(self.renders))
        similarity = sum(similarities) / len(similarities) if similarities else None
        return Closeness(tuple(errors), similarity, self.views.width)

    def psnr_of_covered(self, psnr: float) -> float:
        """PSNR over the pixels that the dense scene covers, dB, from the PSNR over all pixels. It assumes that other
        pixels have no error. An object that covers few pixels gets no better figure for its empty background."""
        return psnr + 10 * math.log10(self.covered) if self.covered > 0 else psnr

    def psnr(self, scene: Gaussians) -> tuple[float, float]:
        """PSNR over all pixels of all views, and of the worst view, dB."""
        close = Closeness(tuple(self.errors(scene)), None)
        return close.psnr, close.worst


def _psnr(mse: float) -> float:
    """PSNR, in dB, of a mean squared error: inf for 0, NaN for NaN."""
    return math.inf if mse == 0 else -10 * math.log10(mse) if mse > 0 else math.nan


def views_text(count: int) -> str:
    """A number of views in words: "1 view", "3 views"."""
    return f"{count} view{'s' if count != 1 else ''}"
