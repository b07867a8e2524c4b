"""Judges scenes: against the dense scene's renders and photos, and by the time of a frame.

On a shared machine the time of a frame may double within a minute. So each frame is timed beside a frame of the dense
scene in the same view: both slow down alike, and the ratio of their times stays.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from statistics import fmean

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import DenseReference, views_text
from pointsplat_ns.looking.fill import fill
from pointsplat_ns.looking.view_source import VIEW_COUNTS, ViewSource
from pointsplat_ns.metrics import MOST_PSNR, SSIM_WINDOW, ImageError, finite_psnr, ssim
from pointsplat_ns.metrics.lpips import Lpips, LpipsUnavailable, load_lpips
from pointsplat_ns.rasterizer import render
from pointsplat_ns.system.cores import OtherPrograms
from pointsplat_ns.system.threads import fixed_threads
from pointsplat_ns.tradeoff.points import ImageMetrics
from pointsplat_ns.views import View, Views

ROUNDS = 3
"""Number of timed frames of each view, alternating between the dense scene and the judged scene."""


@dataclass(frozen=True)
class JudgedViews:
    """The views that scenes are judged in."""

    views: Views
    photos: list[Tensor] | None  # [H, W, 3] in [0, 1], the photo of each view; None where there are none
    origin: str
    """Text on the origin of the views."""

    @property
    def where(self) -> str:
        """Text: the number of views, and their width."""
        of = "" if self.photos is None else " of held-out photos"
        return f"{views_text(len(self.views))}{of}, {self.views.width} pixels wide"

    @staticmethod
    def compared(source: ViewSource, count: int) -> JudgedViews:
        """At most ``count`` views without photos: the views of comparisons in ``compact``, which no optimisation uses.
        Raises DataError if there are none."""
        views = source.compared().spread(min(count, VIEW_COUNTS.compared))
        return JudgedViews(views, None, source.origin)

    def resized(self, side: int) -> JudgedViews:
        """The same with at most ``side`` pixels on the longer side; photos are averaged over the areas of pixels."""
        views = self.views.resized(side)
        if self.photos is None or views is self.views:
            return JudgedViews(views, self.photos, self.origin)
        size = (views.height, views.width)
        photos = [
            torch.nn.functional.interpolate(photo.permute(2, 0, 1)[None], size, mode="area")[0].permute(1, 2, 0)
            for photo in self.photos
        ]
        return JudgedViews(views, photos, self.origin)


@dataclass(frozen=True)
class Judged:
    """Figures of a scene; each is a field of :class:`~pointsplat_ns.tradeoff.points.Point`. Times are NaN where nothing
    was timed."""

    against_dense: ImageMetrics
    against_photos: ImageMetrics | None
    fill: float
    frame_ms: float = math.nan
    frame_ms_low: float = math.nan
    frame_ms_high: float = math.nan
    clock_ms: float = math.nan
    others_cores: float = math.nan


class Judge:
    """Judges scenes in the same views, against the same targets: the dense scene's renders, and photos if there are
    some.

    ``dense_ms`` is the time of a frame of the dense scene in milliseconds, the unit of measured ratios; by default it
    is measured beside the first timed scene. Raises DataError if the views are too small for SSIM.
    """

    @torch.no_grad()
    def __init__(self, dense: Gaussians, judged_views: JudgedViews, dense_ms: float | None = None):
        self.views, self.photos, self.dense, self.dense_ms = judged_views.views, judged_views.photos, dense, dense_ms
        if min(self.views.width, self.views.height) < SSIM_WINDOW:
            raise DataError(
                f"views are {self.views.width} x {self.views.height} pixels; expected at least {SSIM_WINDOW} a side"
            )
        self.reference = DenseReference(dense, self.views)
        self.lpips, self.no_lpips = _lpips(self.reference.renders[0])

    @torch.no_grad()
    def judge(self, scene: Gaussians, progress: Callable[[float], None], timed: bool = True) -> Judged:
        """Render a scene, and time it if ``timed``. ``progress`` is called with the share done."""
        images = []
        passes = 1 + 2 * ROUNDS * timed
        for view in self.views:
            images.append(render(scene, view))
            progress(len(images) / (passes * len(self.views)))
        photos = None
        if self.photos is not None:
            pairs = [(image, photo.to(image)) for image, photo in zip(images, self.photos, strict=True)]
            similarity = fmean(float(ssim(*pair)) for pair in pairs)
            photos = ImageMetrics(fmean(finite_psnr(*pair) for pair in pairs), similarity, self._perceived(pairs))
        times = self._time(scene) if timed else {}
        progress(1.0)
        close = self.reference.closeness_of(images)
        assert close.ssim is not None
        perceived = self._perceived(zip(images, self.reference.renders, strict=True))
        return Judged(
            ImageMetrics(min(close.psnr, MOST_PSNR), close.ssim, perceived), photos, fill(scene, self.views), **times
        )

    def _time(self, scene: Gaussians) -> dict[str, float]:
        """The times of :class:`Judged`: ``dense_ms`` times the measured ratio of frames."""
        others = OtherPrograms()
        with fixed_threads(torch.get_num_threads()):  # the same number for all frames
            pairs = [(_timed(self.dense, view), _timed(scene, view)) for _ in range(ROUNDS) for view in self.views]
        rounds = np.array(pairs).reshape(ROUNDS, len(self.views), 2)  # seconds
        dense_ms, clock_ms = (1000 * float(np.median(rounds.min(axis=0)[:, which])) for which in (0, 1))
        if self.dense_ms is None:
            self.dense_ms = dense_ms
        shares = np.median(rounds[..., 1] / rounds[..., 0], axis=0)  # of each view
        low, middle, high = (float(value) for value in np.quantile(shares, (0.25, 0.5, 0.75)))
        unit = self.dense_ms / (middle if scene is self.dense else 1.0)  # the dense scene is as fast as itself
        times = {"frame_ms": middle * unit, "frame_ms_low": low * unit, "frame_ms_high": high * unit}
        return {**times, "clock_ms": clock_ms, "others_cores": others.cores()}

    @torch.no_grad()
    def psnr(self, scene: Gaussians) -> float:
        """PSNR of a scene against the dense scene's renders, over the pixels that the dense scene covers, dB."""
        return min(self.reference.psnr(scene)[0], MOST_PSNR)

    def _perceived(self, pairs: Iterable[tuple[Tensor, Tensor]]) -> float | None:
        """Mean LPIPS over pairs of pictures; None without its weights."""
        return None if self.lpips is None else fmean(float(self.lpips(*pair)) for pair in pairs)


def _timed(scene: Gaussians, view: View) -> float:
    """Seconds of drawing a view."""
    _wait_for(scene.device)
    start = time.perf_counter()
    render(scene, view)
    _wait_for(scene.device)
    return time.perf_counter() - start


def _wait_for(device: torch.device) -> None:
    """Wait until a GPU is idle."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _lpips(image: Tensor) -> tuple[Lpips | None, str]:
    """LPIPS for images of this size, or None and the reason. Nothing is downloaded."""
    try:
        lpips = load_lpips("alex", download=False).to(image.device)
        lpips(image, image)
    except LpipsUnavailable:  # its text names folders, which the page must not show
        return None, "LPIPS is missing: its weights are not at hand; see docs/training.md on POINTSPLAT_LPIPS_WEIGHTS"
    except ImageError as error:  # an image too small for the network
        return None, f"LPIPS is missing: {error}"
    return lpips, ""
