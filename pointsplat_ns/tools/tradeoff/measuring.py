"""Measures a point: compares a smaller scene with the dense scene and photos, and times its frames.

On a shared machine, frame times may double within a minute. So every frame is timed next to a frame
of the dense scene in the same view: both slow down alike, and the ratio of their times stays.
"""

from __future__ import annotations

import functools
import platform
import re
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.metrics import SSIM_WINDOW, ssim
from pointsplat_ns.pipeline.photos.examples import Example, Photos
from pointsplat_ns.pipeline.quality import Judge
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS
from pointsplat_ns.pruning import need_usable, ply_bytes
from pointsplat_ns.rendering import render
from pointsplat_ns.rendering.comparison.sizes import longer_side, middle_sized
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.image_files import in_unit_range
from pointsplat_ns.scene.views import ImageSize, View, Views, sizes_text, spread_indices
from pointsplat_ns.system.cores import OtherPrograms, cores
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.system.threads import most_threads, now
from pointsplat_ns.tools.tradeoff.estimate import measuring_seconds, unit_seconds
from pointsplat_ns.tools.tradeoff.measured_scene import Subject
from pointsplat_ns.tools.tradeoff.points import DENSE, ImageMetrics, Point, Setting, Speed
from pointsplat_ns.tools.wording import origin_text

ROUNDS = 3
"""Number of timed frames per view, alternating between the dense scene and the measured one."""


class JudgedViews(NamedTuple):
    """Views to draw and time, their photos of the same sizes in [0, 1], if any, and a text on their
    origin."""

    views: Views
    photos: list[Example] | None
    origin: str


def views_to_judge(subject: Subject, count: int, shrink: int = 1) -> tuple[JudgedViews, str]:
    """At most ``count`` views of a middle size, divided by ``shrink``, and a note.

    They are views of held-out photos, which are reduced by averaging, or else the views of the
    :class:`~pointsplat_ns.pipeline.quality.Judge`. Raises DataError if there are none."""
    note = ""
    if subject.held_out is not None:
        try:
            views, photos = photos_with_views(subject.held_out(), count)
            small = views.each_size(functools.partial(_middle_sized, most=subject.resolution))
            small = _shrunk(small, shrink)
            if small is not views:
                photos = [_averaged(photo, view) for photo, view in zip(photos, small, strict=True)]
            origin = f"held-out photos of {subject.photos or 'the dataset'}"
            return JudgedViews(small, photos, origin), note
        except (SceneError, DataError) as error:
            note = f"there are no held-out photos: {error}"
    source = subject.new_views()
    views = source.compared().spread(min(count, VIEW_COUNTS.compared))
    return JudgedViews(_shrunk(views, shrink), None, origin_text(source.origin)), note


def _middle_sized(views: Views, most: tuple[int, int] | None) -> Views:
    """Views of one size, reduced to the middle size of at most ``most`` pixels."""
    whole = views if most is None else views.resized(max(most))
    return views.resized(longer_side(middle_sized(whole)))


def _shrunk(views: Views, by: int) -> Views:
    """Views whose pictures have sides divided by a number."""
    if by == 1:
        return views
    return views.each_size(lambda some: some.resized(longer_side(some) // by))


def photos_with_views(photos: Photos, count: int) -> tuple[Views, list[Example]]:
    """Views of at most ``count`` photos, and these photos in [0, 1]. Raises DataError if there is
    no photo."""
    shown = [photos[index] for index in spread_indices(len(photos), count)]
    if not shown:
        raise DataError("there is no held-out photo")
    first = shown[0].view
    viewmats, Ks = (
        torch.stack(mats) for mats in zip(*((s.view.viewmat, s.view.K) for s in shown), strict=True)
    )
    views = Views(
        viewmats,
        Ks,
        first.width,
        first.height,
        first.background,
        first.rasterize_mode,
        images=[ImageSize(example.view.width, example.view.height) for example in shown],
    )
    return views, [
        example._replace(target=in_unit_range(example.target).float()) for example in shown
    ]


def _averaged(photo: Example, view: View) -> Example:
    """A photo reduced to the size of a view by averaging; a pixel is valid if half of its area
    is."""

    def reduced(image: Tensor) -> Tensor:
        planes = image.permute(2, 0, 1)[None].float()
        size = (view.height, view.width)
        return torch.nn.functional.interpolate(planes, size, mode="area")[0].permute(1, 2, 0)

    mask = None if photo.mask is None else reduced(photo.mask) >= 0.5
    return Example(view, reduced(photo.target), mask)


class Measurer:
    """Judges scenes as every command does, and measures frame times and errors against photos.

    ``views`` is the maximum number of timed views and of photos, and ``shrink`` divides the size of
    their pictures. Raises SceneError if no Gaussian can be drawn, and DataError if there are no
    views, or they are too small for SSIM."""

    def __init__(self, subject: Subject, views: int, shrink: int = 1):
        need_usable(subject.dense)
        self.subject = subject
        self.dense = subject.dense
        self._dense_ms: float | None = None
        """Frame time of the dense scene, which is measured first: the unit of ratios."""
        self.judge = Judge(self.dense, subject.new_views())
        self.judged, self.note = views_to_judge(subject, views, shrink)
        shown = self.judged.views
        if min(min(size[:2]) for size in shown.image_sizes()) < SSIM_WINDOW:
            size = f"{sizes_text(shown.image_sizes())} pixels"
            raise DataError(f"views are {size}; expected at least {SSIM_WINDOW} per side")

    def point(self, setting: Setting, scene: Gaussians, seconds: float, show: Progress) -> Point:
        """Measure the point of a setting, from its scene and the duration of making it. The dense
        scene must come first. ``show`` is called with the name of the current task and its share
        done."""
        show("comparing", 0.0)
        quality = self.judge.quality(scene)
        assert quality.ssim is not None
        against_photos = self._against_photos(scene)
        speed, others_cores = self._speed(scene, show)
        if setting.by == DENSE:  # as fast as itself
            speed = Speed(1.0, speed.low / speed.median, speed.high / speed.median)
        assert self._dense_ms is not None
        return Point(
            **self.subject.names(setting),
            by=setting.by,
            share=setting.count / len(self.dense),
            gaussians=len(scene),
            repair=setting.repair,
            bytes=ply_bytes(len(scene), scene.sh_degree),
            against_dense=ImageMetrics(quality.psnr, quality.ssim),
            against_photos=against_photos,
            speed=speed,
            frame_ms=self._dense_ms / speed.median,
            fill=quality.fill,
            seconds=seconds,
            others_cores=others_cores,
        )

    @torch.no_grad()
    def expected_seconds(self, settings: Sequence[Setting]) -> float:
        """Estimated duration of measuring all points, seconds."""
        view = self.judged.views[0]
        frame = min(_timed(self.dense, view) for _ in range(2))
        frames = ROUNDS * len(self.judged.views)
        return measuring_seconds(settings, len(self.dense), frames, frame, unit_seconds())

    @torch.no_grad()
    def _against_photos(self, scene: Gaussians) -> ImageMetrics | None:
        if self.judged.photos is None:
            return None
        photos = self.judged.photos
        views = self.judged.views
        pairs = [(photo, render(scene, view)) for photo, view in zip(photos, views, strict=True)]
        similar = fmean(float(ssim(*photo.compared(image))) for photo, image in pairs)
        return ImageMetrics(fmean(photo.psnr(image) for photo, image in pairs), similar)

    @torch.no_grad()
    def _speed(self, scene: Gaussians, show: Progress) -> tuple[Speed, float | None]:
        """Ratio of frame times, and the number of cores that other programs used meanwhile."""
        others = OtherPrograms()
        pairs = []
        views = self.judged.views
        for _ in range(ROUNDS):
            for view in views:
                pairs.append((_timed(self.dense, view), _timed(scene, view)))
                show("timing frames", len(pairs) / (ROUNDS * len(views)))
        rounds = np.array(pairs).reshape(ROUNDS, len(views), 2)  # seconds
        if self._dense_ms is None:
            self._dense_ms = 1000 * float(np.median(rounds[..., 0].min(axis=0)))
        ratios = np.median(rounds[..., 0] / rounds[..., 1], axis=0)  # of each view
        low, median, high = np.quantile(ratios, (0.25, 0.5, 0.75)).tolist()
        return Speed(median, low, high), others.cores()


def _timed(scene: Gaussians, view: View) -> float:
    """Time to draw a view, seconds."""
    start = now(scene.device)
    render(scene, view)
    return now(scene.device) - start


def machine_text(device: torch.device) -> str:
    """Processor, number of threads, device and version of torch, as text."""
    threads = most_threads()
    models = []
    cpuinfo = Path("/proc/cpuinfo")  # on Linux
    if cpuinfo.exists():
        text = cpuinfo.read_text("utf-8", "replace")
        models = re.findall(r"^model name\s*: *(.*)", text, re.M)
    processor = next(iter(models), "") or platform.processor() or platform.machine()
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    return (
        f"{processor}, {threads} thread{'s' if threads != 1 else ''}, {where}, torch "
        f"{torch.__version__}"
    )


def busy_note(others: Sequence[float | None]) -> str:
    """Text on measurements disturbed by other programs; empty if there are none. ``others`` are the
    cores that these used during each measurement; None if nothing was timed. A quarter of a core
    does not change medians."""
    timed = [used for used in others if used is not None]
    disturbed = [used for used in timed if used + most_threads() > cores() + 0.25]
    if not disturbed:
        return ""
    return (
        f"the machine was busy: while {len(disturbed)} of {len(timed)} points were timed, other "
        f"programs took up to {max(disturbed):.1f} of {cores()} cores; times are unreliable"
    )
