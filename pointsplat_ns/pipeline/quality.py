"""How close a written scene is to the dense scene: one judgement, reported identically by commands,
pages and pictures.

Renders are compared in the views of
:meth:`~pointsplat_ns.pipeline.view_provider.ViewProvider.whole`, at the size that people look at,
in few of their pixels. For PSNR these are every k-th
(:mod:`~pointsplat_ns.rendering.comparison.sizes`). SSIM needs neighbours, so it takes bands of rows
of each view, at other heights in each.
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
from pointsplat_ns.rendering.comparison.sizes import subsampled
from pointsplat_ns.scene.formats import Format, format_to_write
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.usable import usable_part
from pointsplat_ns.system.progress import silent
from pointsplat_ns.system.tensors import DOUBLES, INDICES
from pointsplat_ns.system.threads import one_thread_each


@dataclass(frozen=True)
class JudgingSettings:
    """Pixels that are drawn of a view of 1920 x 1080 pixels."""

    side: int = 240
    """Longer side of the subsampled picture for PSNR, pixels."""
    bands: int = 2
    """Number of bands of rows for SSIM. It is within 0.01 of that of whole pictures in two rooms
    and a statue, 0.03 in a robot on gravel; with one band within 0.03."""
    band_rows: int = 13
    """Least number of rows of a band; SSIM takes windows of 11."""
    band_pixels: int = 24_960
    """Pixels of a band; narrower pictures have more rows."""


JUDGING = JudgingSettings()


@dataclass(frozen=True)
class PhotoGain:
    """What training on photos gained."""

    before: float
    """PSNR in the compared photos before, dB."""
    after: float
    """The same after."""
    photos: int
    """Number of the compared photos."""
    accepted: bool
    """Whether the scene after it is the result."""


@dataclass(frozen=True)
class Quality:
    """How close a scene is to the dense scene."""

    psnr: float
    """PSNR over the pixels that the dense scene covers, dB; inf if nothing differs."""
    worst: float
    """The same of the worst view, dB."""
    ssim: float | None
    """SSIM over the pixels on which the dense scene draws anything, in [-1, 1]; None for pictures
    below its window."""
    views: int
    """Number of views."""
    width: int
    """Width of their pictures, pixels."""
    height: int
    """Height of their pictures, pixels."""
    origin: ViewOrigin | None
    """Where the views came from."""
    fill_before: float
    """Mean number of Gaussians of the dense scene that viewers draw on a pixel."""
    fill: float
    """The same of the scene."""
    photos: PhotoGain | None = None
    """What photos say, if the scene was trained on some."""
    opacity: float = 1.0
    """Mean opacity of the dense scene, in [0, 1], where it draws anything."""


class Judge:
    """Judges scenes against the dense scene.

    Args:
        dense: N Gaussians.
        source: source of views.

    Raises:
        DataError: if there is no place to look from.
    """

    def __init__(self, dense: Gaussians, source: ViewProvider):
        self.dense = dense
        self.views = source.whole()
        self.origin = source.origin
        self.side = max(self.views.width, self.views.height)

    @cached_property
    def _pixels(self) -> DenseReference:
        return DenseReference(
            self.dense, subsampled(self.views, self.side, min(self.side, JUDGING.side))
        )

    @cached_property
    def _bands(self) -> DenseReference | None:
        views = self.views
        if min(views.width, views.height) < SSIM_WINDOW:
            return None
        rows = min(views.height, max(JUDGING.band_rows, JUDGING.band_pixels // views.width))
        views = views[torch.arange(len(views), **INDICES).repeat_interleave(JUDGING.bands)]
        tops = (0.618 * torch.arange(len(views), **DOUBLES)).frac() * (
            views.height - rows
        )  # spread evenly
        Ks = views.Ks.clone()
        Ks[:, 1, 2] -= tops.round().to(Ks)
        return DenseReference(self.dense, replace(views, Ks=Ks, height=rows))

    def psnr(
        self, scene: Gaussians, progress: Callable[[float], None] | None = None
    ) -> tuple[float, float]:
        """PSNR of a scene over all views, and of the worst view, dB."""
        return self._pixels.psnr(self._placed(scene), progress)

    @one_thread_each()  # views are drawn at once, and what is left are small operations
    def quality(self, scene: Gaussians) -> Quality:
        """The judgement of a scene."""
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


def quality_of_file(judge: Judge | None, scene: Gaussians, path: Path) -> Quality | None:
    """The quality of a scene as it is in the file that it was written to; None without a judge."""
    return None if judge is None else judge.quality(read_back(scene, path, format_to_write(path)))


def judge_of(dense: Gaussians, source: ViewProvider) -> Judge | None:
    """The judge of a scene; None if there is no place to look from."""
    try:
        return Judge(dense, source)
    except DataError:
        return None


def read_back(scene: Gaussians, path: Path, kind: Format) -> Gaussians:
    """The scene in a file of a format, which ``scene`` was written to; ``scene`` itself where
    nothing is lost, or nothing reads the format."""
    return (
        scene
        if kind.suffix == ".ply" or kind.read is None
        else usable_part(kind.read(path)).to(scene.device)
    )


def through_file(scene: Gaussians, suffix: str) -> tuple[int, Gaussians]:
    """The size of a scene's file of a suffix such as ``.spz`` in bytes, and the scene after writing
    and reading (:func:`read_back`)."""
    kind = format_to_write(suffix)
    if kind.suffix == ".ply":
        return ply_bytes(len(scene), scene.sh_degree), scene
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"scene{suffix}"
        assert kind.write is not None
        # Without the warning of losses, which is for the scene that is kept.
        kind.write(usable_part(scene.detach().to("cpu", torch.float32)), path, silent)
        return path.stat().st_size, read_back(scene, path, kind)
