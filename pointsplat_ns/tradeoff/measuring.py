"""Measures one point: compares a smaller scene with the dense scene and with photos, and times its frames.

On a shared machine the time of a frame may double within a minute. So each frame is timed beside a frame of the dense
scene in the same view: both slow down alike, and the ratio of their times stays.
"""

from __future__ import annotations

import functools
import math
import platform
import re
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.compression.budget_search import FileLimit
from pointsplat_ns.compression.compact import rounding_stage
from pointsplat_ns.compression.optimiser import Example
from pointsplat_ns.compression.photo_repair import Photos
from pointsplat_ns.compression.quality import Judge, through_file
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.io.formats.rounding import ROUNDING, rounding_for
from pointsplat_ns.io.pictures import in_unit_range
from pointsplat_ns.looking.sizes import middle_sized
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.metrics import SSIM_WINDOW, ImageError, ssim
from pointsplat_ns.metrics.lpips import Lpips, LpipsUnavailable, load_lpips
from pointsplat_ns.pruning import cut_sh, need_usable
from pointsplat_ns.rasterizer import render
from pointsplat_ns.system.cores import OtherPrograms, cores
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.threads import fixed_threads
from pointsplat_ns.tradeoff.making import MadeScene, Subject, make
from pointsplat_ns.tradeoff.points import DENSE, ImageMetrics, Point, Setting
from pointsplat_ns.views import View, Views, spread_indices

ROUNDS = 3
"""Number of timed frames of each view, alternating between the dense scene and the measured scene."""


class JudgedViews(NamedTuple):
    """The views that scenes are drawn and timed in, and compared with photos."""

    views: Views
    photos: list[Example] | None
    """The photo of each view, of its size, in [0, 1]; None where there are none."""
    origin: str
    """Text on the origin of the views."""


def views_to_judge(subject: Subject, count: int) -> tuple[JudgedViews, str]:
    """At most ``count`` views of a middle size, and a note. They are the views of held-out photos, which are averaged
    over the areas of pixels, or else those of the :class:`~pointsplat_ns.compression.quality.Judge`. Raises DataError
    if there are none."""
    note = ""
    if subject.held_out is not None:
        try:
            views, photos, note = photos_of_one_size(subject.held_out(), count)
            whole = views if subject.resolution is None else views.resized(max(subject.resolution))
            middle = middle_sized(whole)
            small = views.resized(max(middle.width, middle.height))
            if small is not views:
                photos = [_averaged(photo, view) for photo, view in zip(photos, small, strict=True)]
            return JudgedViews(small, photos, f"held-out photos of {subject.photos or 'the dataset'}"), note
        except (SceneError, DataError) as error:
            note = f"there are no held-out photos: {error}"
    source = subject.new_views()
    return JudgedViews(source.compared().spread(min(count, VIEW_COUNTS.compared)), None, source.origin), note


def photos_of_one_size(photos: Photos, count: int) -> tuple[Views, list[Example], str]:
    """At most ``count`` photos of one size, their views, and a note on photos of other sizes."""
    shown = [photos[index] for index in spread_indices(len(photos), count)]
    if not shown:
        raise DataError("no photo is held out")
    sizes = [example.target.shape for example in shown]
    size = max(sizes, key=sizes.count)
    of_size = [example for example in shown if example.target.shape == size]
    first = of_size[0].view
    viewmats, Ks = (torch.stack(mats) for mats in zip(*((s.view.viewmat, s.view.K) for s in of_size), strict=True))
    views = Views(viewmats, Ks, first.width, first.height, first.background, first.rasterize_mode)
    others = len(shown) - len(of_size)
    note = f"{others} of {len(shown)} held-out photos are of another size and left out" if others else ""
    return views, [example._replace(target=in_unit_range(example.target).float()) for example in of_size], note


def _averaged(photo: Example, view: View) -> Example:
    """A photo reduced to a view, by the mean of each area; a pixel counts if half of its area does."""

    def reduced(image: Tensor) -> Tensor:
        planes = image.permute(2, 0, 1)[None].float()
        return torch.nn.functional.interpolate(planes, (view.height, view.width), mode="area")[0].permute(1, 2, 0)

    return Example(view, reduced(photo.target), None if photo.mask is None else reduced(photo.mask) >= 0.5)


class Measurer:
    """Makes scenes of settings, judges them as every command does, and measures them in the same views: frame times,
    and errors against photos if there are some.

    Args:
        subject: the scene.
        views: largest number of views that are timed, and of photos.
        progress: called with the task and its share done.
        timed: whether frames are timed; if not, times are NaN.

    Raises:
        SceneError: if no Gaussian can be drawn.
        DataError: if there are no views, or they are too small for SSIM.
    """

    def __init__(self, subject: Subject, views: int, progress: Progress, timed: bool = True):
        need_usable(subject.dense)
        self.subject, self.dense, self.timed = subject, subject.dense, timed
        self.dense_ms: float | None = None
        """Time of a frame of the dense scene, the unit of measured ratios; by default measured with the first scene."""
        self.notes: dict[str, None] = {}
        self._kept: dict[Setting, MadeScene] = {}
        progress("looking for views", 0.0)
        self.judge = Judge(self.dense, subject.new_views())
        self.judged_views, note = views_to_judge(subject, views)
        self.note(note)
        shown = self.judged_views.views
        if min(shown.width, shown.height) < SSIM_WINDOW:
            raise DataError(f"views are {shown.width} x {shown.height} pixels; expected at least {SSIM_WINDOW} a side")

    def note(self, text: str) -> None:
        """Keep a line of text for the reader, once, unless it is empty."""
        if text:
            self.notes[text] = None

    @functools.cached_property
    def renders(self) -> list[Tensor]:
        """Renders of the dense scene, for LPIPS."""
        return [render(self.dense, view) for view in self.judged_views.views]

    @functools.cached_property
    def lpips(self) -> Lpips | None:
        """LPIPS for pictures of this size; None without its weights, with a note. Nothing is downloaded."""
        image = self.renders[0]
        try:
            lpips = load_lpips("alex", download=False).to(image.device)
            lpips(image, image)
            return lpips
        except LpipsUnavailable:  # its text names folders, which the page must not show
            self.note("LPIPS is missing: its weights are not at hand; POINTSPLAT_LPIPS_WEIGHTS names their folder")
        except ImageError as error:  # an image too small for the network
            self.note(f"LPIPS is missing: {error}")
        return None

    def cut_psnr(self, degree: int) -> float:
        """PSNR in dB of the dense scene's renders without the SH bands above a degree, against all bands."""
        return self.judge.psnr(cut_sh(self.dense, degree))[0]

    def measure_dense(self, show: Progress) -> Point:
        """The dense scene's point; ``show`` as for :meth:`measure`."""
        setting = Setting(len(self.dense), self.dense.sh_degree, by=DENSE)
        return self._point(setting, MadeScene(self.dense, 0.0, None), show)

    def measure(self, setting: Setting, show: Progress) -> Point:
        """The point of a setting. ``show`` is called with the name of the current task and its share done."""
        return self._point(setting, self.made(setting, show), show)

    def made(self, setting: Setting, show: Progress = silent) -> MadeScene:
        """The scene of a setting. The latest scenes are kept, with no more Gaussians in all than the dense scene."""
        if setting not in self._kept:
            subject = self.subject
            made = make(self.dense, setting, subject.new_views, show, subject.refiner, subject.training)
            self._kept[setting] = self._rounded(made)
            while len(self._kept) > 1 and sum(len(kept.scene) for kept in self._kept.values()) > len(self.dense):
                self._kept.pop(next(iter(self._kept)))
        return self._kept[setting]

    def _rounded(self, made: MadeScene) -> MadeScene:
        """The scene of a compressed file: its numbers are rounded as far as its error allows, as by ``--keep auto``."""
        kind = format_to_write(self.subject.suffix)
        if kind.rounded is None or (psnr := self.judge.psnr(made.scene)[0]) > ROUNDING.best_psnr:
            return made
        limit, compacted = FileLimit(kind, math.inf, rounding_for(psnr, made.scene.sh_degree)), made.compacted
        if compacted is None:
            return replace(made, scene=limit.rounded(made.scene))
        compacted = replace(
            compacted, stages=(*compacted.stages, *rounding_stage(compacted.last, limit, compacted.reference))
        )
        return replace(made, scene=compacted.scene.to(made.scene.device), compacted=compacted)

    def _point(self, setting: Setting, made: MadeScene, show: Progress) -> Point:
        size, scene = through_file(made.scene, self.subject.suffix)
        return Point(
            **self.subject.names(setting), by=setting.by, share=setting.count / len(self.dense),
            gaussians=len(made.scene), sh_degree=made.scene.sh_degree, repair=setting.repair, bytes=size,
            **self._compared(scene, lambda done: show("comparing", done)),
            **self._times(scene, lambda done: show("timing frames", done)),
            seconds=made.seconds, peak_bytes=made.peak_bytes,
        )  # fmt: skip

    @torch.no_grad()
    def _compared(self, scene: Gaussians, progress: Callable[[float], None]) -> dict[str, Any]:
        """The figures of a point that are seen in its renders."""
        (views, photos, _), images, against_photos, quality = self.judged_views, [], None, self.judge.quality(scene)
        drawn = views if self.lpips is not None or photos is not None else views[:0]
        progress(1 / (1 + len(drawn)))
        for view in drawn:
            images.append(render(scene, view))
            progress((1 + len(images)) / (1 + len(drawn)))
        if photos is not None:
            psnr = fmean(photo.psnr(image) for image, photo in zip(images, photos, strict=True))
            pairs = [photo.compared(image) for image, photo in zip(images, photos, strict=True)]
            similarity = fmean(float(ssim(*pair)) for pair in pairs)
            against_photos = ImageMetrics(psnr, similarity, self._perceived(pairs))
        perceived = None if self.lpips is None else self._perceived(zip(images, self.renders, strict=True))
        assert quality.ssim is not None
        against_dense = ImageMetrics(quality.psnr, quality.ssim, perceived)
        return {"against_dense": against_dense, "against_photos": against_photos, "fill": quality.fill}

    def _perceived(self, pairs: Iterable[tuple[Tensor, Tensor]]) -> float | None:
        """Mean LPIPS over pairs of pictures; None without its weights."""
        return None if self.lpips is None else fmean(float(self.lpips(*pair)) for pair in pairs)

    @torch.no_grad()
    def _times(self, scene: Gaussians, progress: Callable[[float], None]) -> dict[str, Any]:
        """The times of a point: ``dense_ms`` times the measured ratio of frames."""
        names, views = ("frame_ms_low", "frame_ms", "frame_ms_high"), self.judged_views.views
        if not self.timed:
            return dict.fromkeys(names, math.nan)
        others, pairs = OtherPrograms(), []
        with fixed_threads(torch.get_num_threads()):  # the same number for all frames
            for _ in range(ROUNDS):
                for view in views:
                    pairs.append((_timed(self.dense, view), _timed(scene, view)))
                    progress(len(pairs) / (ROUNDS * len(views)))
        rounds = np.array(pairs).reshape(ROUNDS, len(views), 2)  # seconds
        if self.dense_ms is None:
            self.dense_ms = 1000 * float(np.median(rounds[..., 0].min(axis=0)))
        shares = np.median(rounds[..., 1] / rounds[..., 0], axis=0)  # of each view
        quartiles = np.quantile(shares, (0.25, 0.5, 0.75))
        unit = self.dense_ms / (quartiles[1] if scene is self.dense else 1.0)  # the dense scene is as fast as itself
        times = {name: float(share * unit) for name, share in zip(names, quartiles, strict=True)}
        return {**times, "others_cores": others.cores()}


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


def machine_text(device: torch.device) -> str:
    """Processor, number of threads, device and version of torch, as text."""
    threads, about = torch.get_num_threads(), Path("/proc/cpuinfo")  # of Linux
    models = re.findall(r"^model name\s*: *(.*)", about.read_text("utf-8", "replace"), re.M) if about.exists() else []
    processor = next(iter(models), "") or platform.processor() or platform.machine()
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    return f"{processor}, {threads} thread{'s' if threads != 1 else ''}, {where}, torch {torch.__version__}"


def busy_note(others: Sequence[float | None]) -> str:
    """A line of text if other programs disturbed measurements, from the cores that they used during each, which are
    None where nothing was timed; else empty. A quarter of a core does not change medians."""
    timed = [used for used in others if used is not None]
    disturbed = [used for used in timed if used + torch.get_num_threads() > cores() + 0.25]
    if not disturbed:
        return ""
    return (
        f"the machine was busy: while {len(disturbed)} of {len(timed)} points were timed, other programs took up "
        f"to {max(disturbed):.1f} of {cores()} cores; times are not to be trusted"
    )
