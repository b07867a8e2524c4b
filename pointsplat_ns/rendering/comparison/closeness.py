"""Compares renders of a smaller scene with renders of the dense scene. No photos are needed.

PSNR against the dense scene uses the sum of all squared errors, including halos, over the pixels
that the dense scene covers (:func:`~pointsplat_ns.metrics.psnr_of`), so that empty background does
not improve it. SSIM uses the sum of all lost similarity over the pixels on which the dense scene
draws anything.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.metrics import psnr_of
from pointsplat_ns.metrics.structural_similarity import mean_ssim
from pointsplat_ns.rendering import render_with_alpha
from pointsplat_ns.rendering.comparison.each_view import each_view
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views

LEAST_OPACITY = 0.5
"""Minimum coverage of a pixel on which the dense scene draws. In most scenes, mean opacity is 0.8
to 0.99 on these pixels, so the minimum has no effect. After an opacity reset it is 0.2 to 0.3:
without the minimum, errors would be divided by almost zero."""


@dataclass(frozen=True)
class Closeness:
    """Errors of a scene's renders against those of the dense scene."""

    errors: tuple[float, ...]
    """Mean squared error over all pixels, for each view."""
    covered: tuple[float, ...]
    """Share of the pixels that the dense scene covers, in [0, 1], for each view."""
    width: int | None = None
    """Width of the images, pixels; None if unknown, or if they have several sizes."""

    @property
    def psnr(self) -> float:
        """PSNR over the pixels that the dense scene covers in all views, dB; inf for no error."""
        return psnr_of(sum(self.errors) / len(self.errors), sum(self.covered) / len(self.covered))

    @property
    def worst(self) -> float:
        """PSNR of the worst view, dB."""
        return min(map(psnr_of, self.errors, self.covered))


@dataclass(frozen=True, eq=False)
class Reference:
    """Renders of the dense scene, to compare renders of other scenes with."""

    views: Views
    """C views."""
    renders: list[Tensor]
    """C images (H, W, 3)."""
    covered: tuple[float, ...]
    """Share of the pixels that the dense scene covers, in [0, 1], for each view."""
    alphas: list[Tensor] | None = None
    """C alpha images (H, W, 1), for errors over two backgrounds; None for errors over the views'
    own background."""
    drawn: tuple[float, ...] | None = None
    """Share of the pixels on which the dense scene draws anything, in [0, 1], for each view; None
    for all pixels."""

    def psnr(
        self, scene: Gaussians, progress: Callable[[float], None] | None = None
    ) -> tuple[float, float]:
        """PSNR over all views, and of the worst view, dB; see :class:`Closeness`."""
        close = self.closeness(scene, progress)
        return close.psnr, close.worst

    def closeness(
        self, scene: Gaussians, progress: Callable[[float], None] | None = None
    ) -> Closeness:
        """Errors of a scene; ``progress`` is called with the share of the views done."""
        return self._closeness(_drawn(scene, self.views), progress)

    def closeness_of(self, images: Iterable[Tensor]) -> Closeness:
        """Errors of C images (H, W, 3) over the views' own background."""
        return self._closeness(((image, None) for image in images), None)

    @torch.no_grad()
    def ssim(self, scene: Gaussians) -> float:
        """SSIM of a scene, in [-1, 1]: 1 minus the lost similarity, summed over all windows
        including halos beside the scene, and divided by the share of pixels on which the dense
        scene draws anything (1 if there are none). Clamped at -1. Views must be at least as large
        as the window."""
        total = 0.0
        for (image, _), target in zip(_drawn(scene, self.views), self.renders, strict=True):
            total += float(
                mean_ssim(image.permute(2, 0, 1)[None], target.to(image).permute(2, 0, 1)[None])
            )
        lost = 1 - total / len(self.renders)
        drawn = 1.0 if self.drawn is None else sum(self.drawn) / len(self.drawn)
        return min(max(1 - lost / (drawn or 1.0), -1.0), 1.0)

    @torch.no_grad()
    def _closeness(
        self,
        pictures: Iterable[tuple[Tensor, Tensor | None]],
        progress: Callable[[float], None] | None,
    ) -> Closeness:
        """Errors of images, with their alpha if :attr:`alphas` are compared too."""
        errors: list[float] = []
        for index, ((image, alpha), target) in enumerate(zip(pictures, self.renders, strict=True)):
            apart = image.double() - target.double()
            error = float(apart.square().mean())
            if self.alphas is not None and alpha is not None:
                # from a background to its inverse
                other = (1 - 2 * self.views.background).to(apart)
                over_other = apart - (alpha - self.alphas[index]).double() * other
                error = 0.5 * (error + float(over_other.square().mean()))
            errors.append(error)
            if progress is not None:
                progress(len(errors) / len(self.renders))
        width = self.views.width if self.views.images is None else None
        return Closeness(tuple(errors), self.covered, width)


class DenseReference(Reference):
    """Renders of the dense scene.

    Args:
        dense: N Gaussians.
        views: C views.
        both_backgrounds: average errors over two backgrounds, the views' own and its inverse (white
            for black). The viewer's background is unknown, and a scene that fits one background may
            be too transparent or too opaque for another.
    """

    @torch.no_grad()
    def __init__(self, dense: Gaussians, views: Views, both_backgrounds: bool = False):
        drawn = list(_drawn(dense, views))
        opacities = tuple(float(alpha.double().mean()) for _, alpha in drawn)
        shares = tuple(float((alpha > 0).double().mean()) for _, alpha in drawn)
        super().__init__(
            views,
            [image for image, _ in drawn],
            covered=tuple(map(_covered, opacities, shares)),
            alphas=[alpha for _, alpha in drawn] if both_backgrounds else None,
            drawn=shares,
        )
        self.opacities = opacities
        """Mean opacity over all pixels, in [0, 1], for each view."""

    @property
    def opacity(self) -> float:
        """Mean opacity, in [0, 1], over the pixels on which the scene draws anything; 1 if there
        are none."""
        assert self.drawn is not None
        return sum(self.opacities) / sum(self.drawn) if any(self.drawn) else 1.0


def _covered(opacity: float, drawn: float) -> float:
    """Share of the pixels that a scene covers, from the mean opacity over all pixels and the share
    of pixels on which anything is drawn."""
    return max(opacity, LEAST_OPACITY * drawn)


def _drawn(scene: Gaussians, views: Views) -> Iterator[tuple[Tensor, Tensor]]:
    """Image (H, W, 3) and alpha (H, W, 1) of each view."""
    return each_view(scene, views, render_with_alpha)
