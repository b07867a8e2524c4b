"""Measures points of a scene's trade, one after the other, and keeps what was measured whatever happens."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from torch import Tensor

from pointsplat_ns.compression.view_source import COMPARED_VIEWS, ViewSource
from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pages.flight import Stage
from pointsplat_ns.pruning import cut_sh, method_named, need_usable, ply_bytes
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.system.threads import cores
from pointsplat_ns.tradeoff.flights import keep_flight
from pointsplat_ns.tradeoff.journal import POINTS, Journal
from pointsplat_ns.tradeoff.judging import Judge, Judged, LookedAt
from pointsplat_ns.tradeoff.loss import recommend
from pointsplat_ns.tradeoff.machine import is_busy, machine_text, one_at_a_time
from pointsplat_ns.tradeoff.making import Made, make
from pointsplat_ns.tradeoff.outputs import OUTPUTS, write_outputs
from pointsplat_ns.tradeoff.points import Point, Tradeoff, flight_path
from pointsplat_ns.tradeoff.settings import DENSE, REPAIRS, Naming, Repair, Setting, check_repairs
from pointsplat_ns.tradeoff.walk import Plan, walk
from pointsplat_ns.views import Views

logger = logging.getLogger("pointsplat_ns")

HeldOut = Callable[[int], tuple[Views, list[Tensor]]]
"""From a number to at most so many held-out photos (H, W, 3) of a scene's dataset, and the views that they show."""


@dataclass(frozen=True)
class Options:
    """What to measure, and in which views.

    Raises:
        PointSplatError: if one means nothing.
    """

    points: int = 12
    """Largest number of points, the dense scene among them."""
    within: float = 0.5
    """Loss, dB, that the recommended point may have."""
    methods: tuple[str, ...] = ("merge",)
    repairs: tuple[str, ...] = ("none", "quick")
    views: int = 10
    """Largest number of views."""
    side: int = 640
    """Largest side of their images, pixels."""

    def __post_init__(self) -> None:
        if self.points < 2:
            raise PointSplatError(f"{self.points} points; expected at least 2, of which one is the dense scene")
        if not 0 < self.within < math.inf:
            raise PointSplatError(f"a loss of {self.within:g} dB; expected a positive number, such as 0.5")
        if self.views < 1 or self.side < 1:
            raise PointSplatError(f"{self.views} views of {self.side} pixels; expected at least one view and pixel")
        if not self.methods:
            raise PointSplatError("no method is named; expected at least one, such as merge")
        for method in self.methods:
            method_named(method)
        check_repairs(self.repairs)

    def plan(self, dense: Gaussians) -> Plan:
        """What may be tried of a scene."""
        methods = tuple(dict.fromkeys(self.methods))
        return Plan(len(dense), dense.sh_degree, methods, check_repairs(self.repairs), self.within)


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


def check_folder(folder: Path, force: bool) -> None:
    """Check, before the long computations, that a sweep may write to a folder; with ``force``, remove an older sweep.

    Raises:
        SceneError: if it is a file, or holds results but no points to go on from.
    """
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; expected the name of a folder")
    if force:
        for name in (POINTS, *OUTPUTS):
            (folder / name).unlink(missing_ok=True)
        return
    for name in OUTPUTS:
        if (folder / name).exists() and not (folder / POINTS).exists():
            raise SceneError(
                f"{folder / name}: exists already, without {POINTS} to go on from; name another folder, or overwrite "
                "it with --force"
            )


class Sweep:
    """Measures settings of a scene.

    Args:
        subject: the scene.
        folder: where points, pictures and results go.
        options: what to measure.
        progress: called with the name of the current task and the share of it that is done, in [0, 1].

    Raises:
        SceneError: if no Gaussian can be drawn, or the folder holds points of another sweep.
        DataError: if there is no view.
    """

    def __init__(self, subject: Subject, folder: Path, options: Options, progress: Progress):
        self.subject, self.folder, self.options, self.progress = subject, folder, options, progress
        self.dense = subject.dense
        need_usable(self.dense)
        self.naming = Naming(subject.path, subject.name, len(self.dense), self.dense.sh_degree)
        self.plan = options.plan(self.dense)
        self.machine = machine_text(self.dense.device)
        self._notes: dict[str, None] = {}
        progress("looking for views", 0.0)
        self.looked_at = self._look().resized(options.side)
        views = self.looked_at.views
        identity: dict[str, str | int] = {
            "scene": subject.sha256,
            "machine": self.machine,
            "views": self.looked_at.origin,
            "number of views": len(views),
            "width": views.width,
            "height": views.height,
        }
        self.journal = Journal(folder, identity)
        self.judge = Judge(self.dense, self.looked_at, folder)
        self.note(self.judge.no_lpips)
        self._forget_those_without_pictures()
        self._seconds: list[float] = []
        self._made: tuple[Setting, Gaussians] | None = None
        self._shown = False

    def note(self, text: str) -> None:
        """Keep a line of text for the reader; once, and not if it is empty."""
        if text:
            self._notes[text] = None

    def _look(self) -> LookedAt:
        """The views to judge in: those of held-out photos, or else those that ``compact`` compares in, on which no
        repair is optimised."""
        if self.subject.held_out is not None:
            try:
                views, photos = self.subject.held_out(self.options.views)
                return LookedAt(views, photos, "held-out photos of the dataset")
            except (SceneError, DataError) as error:
                self.note(f"there are no held-out photos: {error}")
        source = self.subject.new_views()
        views = source.compared().spread(min(self.options.views, COMPARED_VIEWS))
        return LookedAt(views, None, source.origin)

    def run(self) -> Tradeoff:
        """Walk the front.

        Raises:
            KeyboardInterrupt, SystemExit: of Ctrl-C or another signal, after results of what was measured were written.
        """
        dense = self.measure_dense(self.options.points)
        try:
            for setting in walk(self.plan, self.journal.points, dense, self.cut_psnr):
                if setting in self.journal.points:
                    continue
                if 1 + len(self.journal.points) >= self.options.points:
                    break
                self.measure(setting, self.options.points)
        except (KeyboardInterrupt, SystemExit):
            self.finish_early()
            raise
        return self.finish()

    def measure_dense(self, of: int | None = None) -> Point:
        """The dense scene's point; ``of`` as for :meth:`measure`."""
        if self.journal.dense is None:
            show = self._shower(0, of)
            with one_at_a_time(self.progress) as alone:
                start = time.perf_counter()
                judged = self.judge.judge(self.dense, DENSE, lambda share: show("", share))
            itself = replace(judged.against_dense, psnr=math.inf)
            setting = Setting(len(self.dense), self.dense.sh_degree, by=DENSE)
            made = Made(self.dense, 0.0, None)
            self._keep_flight(self.dense, DENSE, DENSE)
            point = self._point(setting, made, replace(judged, against_dense=itself), DENSE, DENSE, "")
            self._take(point, time.perf_counter() - start, alone, of)
        assert self.journal.dense is not None
        return self.journal.dense

    def measure(self, setting: Setting, of: int | None = None) -> Point:
        """The point of a setting; measured unless it has been.

        Args:
            setting: what to measure.
            of: at most how many points there will be; None if that is not known.
        """
        key, label = self.naming.key(setting), self.naming.label(setting)
        if setting not in self.journal.points:
            show = self._shower(1 + len(self.journal.points), of)
            with one_at_a_time(self.progress) as alone:
                start = time.perf_counter()
                made = make(self.dense, setting, self.subject.new_views, show)
                judged = self.judge.judge(made.scene, key, lambda share: show("", share))
            self._made = (setting, made.scene)
            self._keep_flight(made.scene, key, label)
            point = self._point(setting, made, judged, key, label, self.naming.command(setting))
            self._take(point, time.perf_counter() - start, alone, of)
            if not self._shown:  # the first useful picture, early
                self._shown = True
                write_outputs(self.result(), self.folder)
        return self.journal.points[setting]

    def _keep_flight(self, scene: Gaussians, key: str, label: str) -> None:
        """Keep a scene for the page, to fly through."""
        if self._stage is not None:
            keep_flight(self._stage, scene, label, flight_path(self.folder, key))

    @cached_property
    def _stage(self) -> Stage | None:
        """Where flights through scenes begin; None if nothing of the dense one is visible."""
        try:
            return Stage.of(self.dense, self.looked_at.views)
        except DataError:
            return None

    def scene(self, setting: Setting) -> Gaussians:
        """The scene of a setting, made anew unless it was the last one made."""
        if self._made is None or self._made[0] != setting:
            self._made = (setting, make(self.dense, setting, self.subject.new_views, self.progress).scene)
        return self._made[1]

    def cut_psnr(self, degree: int) -> float:
        """PSNR, dB, of the dense scene's renders without the SH bands above a degree, against its own."""
        return self.judge.psnr(cut_sh(self.dense, degree))

    def result(self, recommended: Point | None = None, why: str = "") -> Tradeoff:
        """What was measured so far, the dense scene first and the others by their size.

        Args:
            recommended: a point; by default see :func:`~pointsplat_ns.tradeoff.loss.recommend`.
            why: a line of text on it.
        """
        dense = self.journal.dense
        assert dense is not None
        others = sorted(
            self.journal.points.values(),
            key=lambda p: (-p.gaussians, -p.sh_degree, REPAIRS.index(_repair(p)), p.by),
        )
        points = (dense, *others)
        busy = self._busy_note(points)
        if recommended is None:
            recommended, why = recommend(points, self.options.within, trusted=not busy)
        views = self.looked_at.views
        return Tradeoff(
            scene=self.subject.name,
            machine=self.machine,
            views_origin=self.looked_at.origin,
            width=views.width,
            height=views.height,
            points=points,
            notes=(*busy, *self._notes),
            times_trusted=not busy,
            recommended=recommended.key,
            why=why,
        )

    def finish(self, recommended: Point | None = None, why: str = "") -> Tradeoff:
        """Write and give the result; arguments as for :meth:`result`."""
        self.progress("writing results", 0.0)
        result = self.result(recommended, why)
        write_outputs(result, self.folder, self.progress)
        return result

    def finish_early(self) -> None:
        """Write the results of a sweep that is interrupted, if there are any."""
        if self.journal.dense is not None:
            self.note("the sweep was interrupted: the same command goes on with it")
            self.finish()

    def _busy_note(self, points: tuple[Point, ...]) -> list[str]:
        disturbed = [p.others_cores for p in points if p.others_cores is not None and is_busy(p.others_cores)]
        if not disturbed:
            return []
        return [
            f"the machine was busy: while {len(disturbed)} of {len(points)} points were timed, other programs took up "
            f"to {max(disturbed):.1f} of {cores()} cores; times are not to be trusted"
        ]

    def _forget_those_without_pictures(self) -> None:
        """Points whose pictures somebody has removed are measured again: the page shows all of them."""

        def pictured(key: str) -> bool:
            return all(path.is_file() for path in self.judge.pictures(key))

        if self.journal.dense is not None and not pictured(DENSE):
            self.journal.dense = None
        for setting in list(self.journal.points):
            if not pictured(self.naming.key(setting)):
                del self.journal.points[setting]

    def _shower(self, done: int, of: int | None) -> Progress:
        """Progress of one point as a part of the whole, if the whole is known. It never goes back, though making a
        scene has several tasks that each begin at 0."""
        furthest = 0.0

        def show(what: str, share: float) -> None:
            nonlocal furthest
            furthest = max(furthest, 0.5 * share if what else 0.5 + 0.5 * share)
            if of is None:
                self.progress(f"measuring point {done + 1}", furthest)
            else:
                self.progress("measuring", min(1.0, (done + furthest) / of))

        return show

    def _point(self, setting: Setting, made: Made, judged: Judged, key: str, label: str, command: str) -> Point:
        return Point(
            key=key,
            label=label,
            command=command,
            by=setting.by,
            share=setting.count / len(self.dense),
            gaussians=len(made.scene),
            sh_degree=made.scene.sh_degree,
            repair=setting.repair,
            bytes=ply_bytes(len(made.scene), made.scene.sh_degree),
            against_dense=judged.against_dense,
            against_photos=judged.against_photos,
            frame_ms=judged.frame_ms,
            frame_ms_low=judged.frame_ms_low,
            frame_ms_high=judged.frame_ms_high,
            seconds=made.seconds,
            peak_bytes=made.peak_bytes,
            others_cores=judged.others_cores,
        )

    def _take(self, point: Point, seconds: float, alone: bool, of: int | None) -> None:
        """Keep a point, and say what it is and how long the rest may take."""
        if not alone:
            self.note("another user's lock on measurements could not be taken: both may have measured at once")
        self.journal.add(point)
        self._seconds.append(seconds)
        done = 1 + len(self.journal.points)
        quality = [f"{point.against_dense.psnr:.1f} dB against the dense scene"] if point.by != DENSE else []
        quality += [f"{point.against_photos.psnr:.2f} dB against photos"] if point.against_photos is not None else []
        figures = [*quality, f"{point.frame_ms:.3g} ms a frame", f"{point.bytes / 1e6:.2f} MB"]
        left = ""
        if of is not None and done < of:
            minutes = (of - done) * sum(self._seconds) / len(self._seconds) / 60
            left = f" ({done} of at most {of}; {max(1, math.ceil(minutes))} min left at most)"
        logger.info("%s: %s%s", point.label, ", ".join(figures), left)


def _repair(point: Point) -> Repair:
    return check_repairs((point.repair,))[0]
