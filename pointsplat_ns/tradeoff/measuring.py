"""Measures points of a scene's trade: makes a scene, judges it and times it, while no other measurement runs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from pointsplat_ns.compression.trained_refiner import TrainedRefiner
from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.looking.windows import middle_sized
from pointsplat_ns.pruning import cut_sh, need_usable
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.tradeoff.judging import Judge, Judged, LookedAt
from pointsplat_ns.tradeoff.machine import one_at_a_time
from pointsplat_ns.tradeoff.making import Made, make, through_file
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import DENSE, Naming, Setting
from pointsplat_ns.views import Views

HeldOut = Callable[[int], tuple[Views, list[Tensor]]]
"""From a number to at most so many held-out photos (H, W, 3) of a scene's dataset, and the views that they show."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The scene in hand."""

    dense: Gaussians
    path: Path
    """Where it was read from, as commands name it."""
    name: str
    sha256: str
    """Of the file."""
    new_views: Callable[[], ViewSource]
    """A fresh source of its views: the one that its commands have."""
    held_out: HeldOut | None = None
    """Its held-out photos; None if it cannot have any."""
    refiner: TrainedRefiner | None = None
    """What repairs begin with; None for nothing, and for the one that ships where it repairs alone."""
    suffix: str = ".ply"
    """Of the format that smaller scenes are written in."""
    poses: Path | None = None
    """The file of cameras that it is looked at from, as commands name it; None if there is none."""
    resolution: tuple[int, int] | None = None
    """Width and height of pictures, pixels, if they were asked for; ``new_views`` has them too."""


class Measurer:
    """Makes scenes of settings and measures them.

    Args:
        subject: the scene.
        views: largest number of views.
        progress: called with what is being waited for.
        folder: for pictures; None for none.
        timed: whether to time frames. If not, times are NaN, and others may measure meanwhile.

    Raises:
        SceneError: if no Gaussian can be drawn.
        DataError: if there is no view.
    """

    def __init__(
        self,
        subject: Subject,
        views: int,
        progress: Progress,
        folder: Path | None = None,
        timed: bool = True,
    ):
        need_usable(subject.dense)
        self.subject, self.dense, self.folder, self.timed = subject, subject.dense, folder, timed
        self.dense_ms: float | None = None
        """Time of a frame of the dense scene that others are given in proportion to; None before it was measured. What
        was measured earlier goes here before anything is judged."""
        self.notes: dict[str, None] = {}
        self.naming = Naming(
            subject.path, subject.name, len(self.dense), self.dense.sh_degree, subject.poses, subject.resolution
        )
        self._kept: dict[Setting, Made] = {}
        self._progress = progress
        progress("looking for views", 0.0)
        self.looked_at = self._look(views)

    def note(self, text: str) -> None:
        """Keep a line of text for the reader; once, and not if it is empty."""
        if text:
            self.notes[text] = None

    def _look(self, count: int) -> LookedAt:
        """The views to judge in: those of held-out photos, or else those that ``compact`` compares in, on which no
        repair is optimised."""
        if self.subject.held_out is not None:
            try:
                views, photos = self.subject.held_out(count)
                whole = views if self.subject.resolution is None else views.resized(max(self.subject.resolution))
                side = max(middle_sized(whole).width, middle_sized(whole).height)
                return LookedAt(views, photos, "held-out photos of the dataset").resized(side)
            except (SceneError, DataError) as error:
                self.note(f"there are no held-out photos: {error}")
        return LookedAt.compared(self.subject.new_views(), count)

    @cached_property
    def judge(self) -> Judge:
        """What judges."""
        judge = Judge(self.dense, self.looked_at, self.folder, self.dense_ms)
        self.note(judge.no_lpips)
        return judge

    def cut_psnr(self, degree: int) -> float:
        """PSNR, dB, of the dense scene's renders without the SH bands above a degree, against its own."""
        return self.judge.psnr(cut_sh(self.dense, degree))

    def measure_dense(self, show: Progress) -> Point:
        """The dense scene's point; ``show`` as for :meth:`measure`."""
        setting = Setting(len(self.dense), self.dense.sh_degree, by=DENSE)
        with self._alone():
            point = self._point(setting, Made(self.dense, 0.0, None), DENSE, DENSE, "", show)
        return replace(point, against_dense=replace(point.against_dense, psnr=math.inf))

    def measure(self, setting: Setting, show: Progress) -> Point:
        """The point of a setting.

        Args:
            setting: what to measure.
            show: called with the name of the current task, empty while it is judged, and the share of it that is done.
        """
        naming = self.naming
        names = (naming.key(setting), naming.label(setting), naming.command(setting))
        with self._alone():
            return self._point(setting, self.made(setting, show), *names, show)

    def made(self, setting: Setting, show: Progress = silent) -> Made:
        """The scene of a setting, made anew unless it is kept: the latest ones are, of no more Gaussians in all than
        the dense scene has."""
        setting = setting.scene
        if setting not in self._kept:
            made = make(self.dense, setting, self.subject.new_views, show, self.subject.refiner)
            self._kept[setting] = made
            while len(self._kept) > 1 and sum(len(kept.scene) for kept in self._kept.values()) > len(self.dense):
                self._kept.pop(next(iter(self._kept)))
        return self._kept[setting]

    @contextmanager
    def _alone(self) -> Iterator[None]:
        if not self.timed:
            yield
            return
        with one_at_a_time(self._progress) as alone:
            yield
        if not alone:
            self.note("another user's lock on measurements could not be taken: both may have measured at once")

    def _point(self, setting: Setting, made: Made, key: str, label: str, command: str, show: Progress) -> Point:
        size, scene = through_file(made.scene, self.subject.suffix)
        judged = self.judge.judge(scene, key, lambda share: show("", share), self.timed, setting.drawn)
        return point_of(
            made,
            judged,
            key=key,
            label=label,
            command=command,
            by=setting.by,
            share=setting.count / len(self.dense),
            repair=setting.repair,
            bytes=size,
            drawn=setting.drawn,
        )


def point_of(made: Made, judged: Judged, **named: Any) -> Point:
    """The point of a scene that was made and judged; ``named`` are the other fields of :class:`Point`."""
    return Point(
        gaussians=len(made.scene),
        sh_degree=made.scene.sh_degree,
        seconds=made.seconds,
        peak_bytes=made.peak_bytes,
        **vars(judged),
        **named,
    )
