"""Judges how close a written scene is to the dense scene, identically for commands, pages and
pictures.

Renders are compared in the views of
:meth:`~pointsplat_ns.pipeline.view_provider.ViewProvider.whole`, at the size that people view, in a
sample of their pixels. PSNR takes every k-th pixel
(:mod:`~pointsplat_ns.rendering.comparison.sizes`). SSIM needs neighbouring pixels, so it takes
bands of rows, at different heights in every view.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.metrics import SSIM_WINDOW
from pointsplat_ns.pipeline.view_provider import ViewOrigin, ViewProvider
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.rendering.comparison.fill import fill
from pointsplat_ns.rendering.comparison.sizes import longer_side, subsampled
from pointsplat_ns.scene.formats import Format, format_to_write
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.usable import usable_part
from pointsplat_ns.scene.views import ImageSize, Views
from pointsplat_ns.system.progress import silent
from pointsplat_ns.system.tensors import DOUBLES, INDICES
from pointsplat_ns.system.threads import one_thread_each


@dataclass(frozen=True)
class JudgingSettings:
    """Pixels to draw of a view of 1920 x 1080 pixels."""

    side: int = 240
    """Longer side of the subsampled picture for PSNR, pixels."""
    bands: int = 2
    """Number of bands of rows for SSIM. Two bands deviate from whole pictures by at most 0.01 in
    two rooms and a statue, and 0.03 in a robot on gravel; one band by 0.03."""
    band_rows: int = 13
    """Minimum number of rows of a band; SSIM takes windows of 11."""
    band_pixels: int = 24_960
    """Pixels of a band; narrower pictures have more rows."""


JUDGING = JudgingSettings()


@dataclass(frozen=True)
class PhotoGain:
    """Gain of training on photos."""

    before: float
    """PSNR in the compared photos before training, dB."""
    after: float
    """The same after training, dB."""
    photos: int
    """Number of compared photos."""
    accepted: bool
    """Whether the trained scene is the result."""


@dataclass(frozen=True)
class Quality:
    """How close a scene is to the dense scene."""

    psnr: float
    """PSNR over the pixels that the dense scene covers, dB; inf for equal renders."""
    worst: float
    """The same of the worst view, dB."""
    ssim: float | None
    """SSIM over the pixels on which the dense scene draws anything, in [-1, 1]; None for pictures
    smaller than its window."""
    views: int
    """Number of views."""
    width: int
    """Width of their pictures, pixels; the most common one, if there are several sizes."""
    height: int
    """Height of their pictures, pixels, as :attr:`width`."""
    origin: ViewOrigin | None
    """Origin of the views."""
    fill_before: float
    """Mean number of Gaussians of the dense scene that viewers draw per pixel."""
    fill: float
    """The same of the scene."""
    photos: PhotoGain | None = None
    """Gain of training on photos; None without training."""
    opacity: float = 1.0
    """Mean opacity of the dense scene on the pixels where it draws anything, in [0, 1]."""
    other_sizes: tuple[ImageSize, ...] = ()
    """Sizes of the pictures that are not of the most common one."""


class Judge:
    """Judges scenes against the dense scene.

    Args:
        dense: N Gaussians.
        source: source of views.

    Raises:
        DataError: if no view can be found.
    """

    def __init__(self, dense: Gaussians, source: ViewProvider):
        self.dense = dense
        self.views = source.whole()
        self.origin = source.origin

    @cached_property
    def _pixels(self) -> DenseReference:
        def drawn(views: Views) -> Views:
            side = longer_side(views)
            return subsampled(views, side, min(side, JUDGING.side))

        return DenseReference(self.dense, self.views.each_size(drawn))

    @cached_property
    def _bands(self) -> DenseReference | None:
        views = self.views
        if min(min(size[:2]) for size in views.image_sizes()) < SSIM_WINDOW:
            return None
        views = views[torch.arange(len(views), **INDICES).repeat_interleave(JUDGING.bands)]
        sizes = views.size_of_each()
        bands = [size._replace(height=_band_rows(size)) for size in sizes]
        # Multiples of the golden ratio spread evenly.
        shares = (0.618 * torch.arange(len(views), **DOUBLES)).frac()
        above = [size.height - band.height for size, band in zip(sizes, bands, strict=True)]
        tops = shares * torch.tensor(above, **DOUBLES)
        Ks = views.Ks.clone()
        Ks[:, 1, 2] -= tops.round().to(Ks)
        return DenseReference(self.dense, replace(views, Ks=Ks, images=bands))

    def psnr(
        self, scene: Gaussians, progress: Callable[[float], None] | None = None
    ) -> tuple[float, float]:
        """PSNR of a scene over all views, and of the worst view, dB."""
        return self._pixels.psnr(self._placed(scene), progress)

    @one_thread_each()  # views are drawn in parallel; the remaining operations are small
    def quality(self, scene: Gaussians) -> Quality:
        """Judge a scene."""
        psnr, worst = self.psnr(scene)
        similarity = None
        if self._bands is not None:
            similarity = self._bands.ssim(self._placed(scene))
        return Quality(
            psnr=psnr,
            worst=worst,
            ssim=similarity,
            views=len(self.views),
            width=self.views.width,
            height=self.views.height,
            other_sizes=tuple(self.views.image_sizes()[1:]),
            origin=self.origin,
            fill_before=self._fill,
            fill=fill(scene, self.views),
            opacity=self._pixels.opacity,
        )

    @cached_property
    def _fill(self) -> float:
        return fill(self.dense, self.views)

    def _placed(self, scene: Gaussians) -> Gaussians:
        return scene.at_offset(self.dense.offset).to(self.dense.device)


def _band_rows(size: ImageSize) -> int:
    """Number of rows of a band of an image."""
    return min(size.height, max(JUDGING.band_rows, JUDGING.band_pixels // size.width))


def quality_of_file(judge: Judge | None, scene: Gaussians, path: Path) -> Quality | None:
    """Quality of a scene as stored in its file; None without a judge."""
    return None if judge is None else judge.quality(read_back(scene, path, format_to_write(path)))


def judge_of(dense: Gaussians, source: ViewProvider) -> Judge | None:
    """The judge of a scene; None if no view can be found."""
    try:
        return Judge(dense, source)
    except DataError:
        return None


def read_back(scene: Gaussians, path: Path, kind: Format) -> Gaussians:
    """The scene as stored in a file; ``scene`` itself if the format is lossless or cannot be
    read."""
    if kind.suffix == ".ply" or kind.read is None:
        return scene
    return usable_part(kind.read(path)).to(scene.device)


def through_file(scene: Gaussians, kind: Format) -> tuple[int, Gaussians]:
    """File size in bytes, and the scene after writing and reading (:func:`read_back`)."""
    if kind.suffix == ".ply":
        return ply_bytes(len(scene), scene.sh_degree), scene
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{kind.suffix}"
        assert kind.write is not None
        # Without the warning of losses, which is for the final scene.
        kind.write(usable_part(scene.detach().to("cpu", torch.float32)), path, silent)
        return path.stat().st_size, read_back(scene, path, kind)
