"""Measures points of a scene one after the other, and writes each as soon as it is measured."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.looking.sizes import size_text
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.pruning import method_named
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.front import recommend
from pointsplat_ns.tradeoff.journal import Journal
from pointsplat_ns.tradeoff.machine import busy_note, machine_text
from pointsplat_ns.tradeoff.measuring import Measurer, Subject
from pointsplat_ns.tradeoff.outputs import SWEEP_FILES, write_outputs
from pointsplat_ns.tradeoff.page import keep_flight
from pointsplat_ns.tradeoff.points import Point, Tradeoff, flight_path, picture_path, speed_of
from pointsplat_ns.tradeoff.settings import DENSE, REPAIRS, Setting, check_repairs
from pointsplat_ns.tradeoff.walk import Enough, Plan, measure_walk

logger = logging.getLogger("pointsplat_ns")


@dataclass(frozen=True)
class SweepOptions:
    """Options of a sweep. Raises PointSplatError if an option is invalid."""

    points: int = 12
    """Largest number of scenes, with the dense scene."""
    within: float = 0.5
    """Largest loss of the recommended point, dB."""
    methods: tuple[str, ...] = ("merge",)
    repairs: tuple[str, ...] = ("none", "quick")
    views: int = VIEW_COUNTS.compared
    """Largest number of views."""

    def __post_init__(self) -> None:
        if self.points < 2:
            raise PointSplatError(f"{self.points} points; expected at least 2, of which one is the dense scene")
        if not 0 < self.within < math.inf:
            raise PointSplatError(f"a loss of {self.within:g} dB; expected a positive number, such as 0.5")
        if self.views < 1:
            raise PointSplatError(f"{self.views} views; expected at least one")
        if not self.methods:
            raise PointSplatError("no method is named; expected at least one, such as merge")
        for method in self.methods:
            method_named(method)
        check_repairs(self.repairs)

    def plan(self, dense: Gaussians) -> Plan:
        """The plan of a scene."""
        methods = tuple(dict.fromkeys(self.methods))
        return Plan(len(dense), dense.sh_degree, methods, check_repairs(self.repairs), self.within)


@contextmanager
def removed_without_points(folder: Path) -> Iterator[None]:
    """On an error before the first point is saved, remove its pictures and scene: nothing could go on from them."""
    places = picture_path(folder, 0, "").parent, flight_path(folder, "").parent
    before = {path for place in places for path in place.glob("*")}
    try:
        yield
    except BaseException:
        if not (folder / FOLDER_FILES.sweep_points).exists():
            for place in places:
                for path in {*place.glob("*")} - before:
                    path.unlink()
                with suppress(OSError):  # it is not there, or not empty
                    place.rmdir()
        raise


class Sweep:
    """Measures settings of a scene, and writes points, pictures and results to a folder. Raises SceneError if no
    Gaussian can be drawn, or the folder holds points of another sweep, and DataError if there is no view."""

    def __init__(self, subject: Subject, folder: Path, options: SweepOptions, progress: Progress):
        self.subject, self.folder, self.options, self.progress = subject, folder, options, progress
        self.measurer = Measurer(subject, options.views, progress, folder)
        self.plan = options.plan(subject.dense)
        self.machine = machine_text(subject.dense.device)
        self.journal = Journal(folder, self._identity())
        if self.journal.dense is not None:
            self.measurer.dense_ms = self.journal.dense.frame_ms
        self._drop_points_without_pictures()

    def _identity(self) -> dict[str, str | int]:
        """Values that comparable points have in common."""
        subject, judged_views = self.subject, self.measurer.judged_views
        views = judged_views.views
        cameras = hashlib.sha256(views.viewmats.numpy().tobytes() + views.Ks.numpy().tobytes()).hexdigest()[:16]
        return {
            "scene": subject.sha256,
            "machine": self.machine,
            "views": judged_views.origin,
            "number of views": len(views),
            "width": views.width,
            "height": views.height,
            "resolution": "" if subject.resolution is None else size_text(subject.resolution),
            **({} if subject.poses is None else {"poses": cameras}),
        }

    def run(self) -> Tradeoff:
        """Measure the points of the walk, and write the results; on Ctrl-C or another signal, those so far."""
        most, points = self.options.points, self.journal.points
        dense = self.measure_dense(most)

        def measure(setting: Setting) -> Point:
            if setting not in points and 1 + len(points) >= most:
                raise Enough
            return self.measure(setting, most)

        try:
            measure_walk(self.plan, measure, dense, self.measurer.cut_psnr)
            self.progress("measuring", 1.0)
        except (KeyboardInterrupt, SystemExit):
            self.finish_early()
            raise
        return self.finish()

    def measure_dense(self, of: int | None = None) -> Point:
        """The dense scene's point; ``of`` as for :meth:`measure`."""
        if self.journal.dense is None:
            self._take(self.measurer.measure_dense(self._shower(0, of)), self.subject.dense)
        assert self.journal.dense is not None
        return self.journal.dense

    def measure(self, setting: Setting, of: int | None = None) -> Point:
        """The point of a setting, measured if it is missing. ``of`` is the largest number of points in the end; None if
        it is not known."""
        if setting not in self.journal.points:
            point = self.measurer.measure(setting, self._shower(1 + len(self.journal.points), of))
            self._take(point, self.scene(setting))
            if not (self.folder / SWEEP_FILES.table).exists():  # the first useful results, early
                write_outputs(self.result(), self.folder)
        return self.journal.points[setting]

    @cached_property
    def _frame(self) -> FlightFrame | None:
        """The frame of flights; None if no Gaussian of the dense scene is visible."""
        try:
            return FlightFrame.of(self.subject.dense, self.measurer.judged_views.views)
        except DataError:
            return None

    def scene(self, setting: Setting) -> Gaussians:
        """The scene of a setting; the latest scenes are kept."""
        return self.measurer.made(setting, self.progress).scene

    def result(self, recommended: Point | None = None, why: str = "") -> Tradeoff:
        """All points so far: the dense scene first, the others by size. By default the recommended point and the line
        of text on it are those of :func:`~pointsplat_ns.tradeoff.front.recommend`."""
        dense = self.journal.dense
        assert dense is not None
        settings = sorted(
            self.journal.points,
            key=lambda s: (-s.count, -s.sh_degree, REPAIRS.index(s.repair), s.by),
        )
        points = (dense, *(self.journal.points[setting] for setting in settings))
        busy = busy_note([p.others_cores for p in points if p.others_cores is not None])
        if recommended is None:
            recommended, why = recommend(points, self.options.within, trusted=not busy)
        judged_views = self.measurer.judged_views
        return Tradeoff(
            scene=self.subject.name,
            machine=self.machine,
            views_origin=judged_views.origin,
            width=judged_views.views.width,
            height=judged_views.views.height,
            points=points,
            notes=(*([busy] if busy else []), *self.measurer.notes),
            times_trusted=not busy,
            recommended=recommended.key,
            why=why,
        )

    def finish(self, recommended: Point | None = None, why: str = "") -> Tradeoff:
        """Write and return the result; arguments as for :meth:`result`."""
        self.progress("writing results", 0.0)
        result = self.result(recommended, why)
        write_outputs(result, self.folder, self.progress)
        return result

    def finish_early(self) -> None:
        """Write the results of an interrupted sweep, if there are any."""
        if self.journal.dense is not None:
            self.measurer.note("the sweep was interrupted: the same command continues it")
            self.finish()

    def _drop_points_without_pictures(self) -> None:
        """Drop points with missing pictures, so that they are measured again: the page needs all pictures."""

        def pictured(key: str) -> bool:
            return all(path.is_file() for path in self.measurer.judge.pictures(key))

        if self.journal.dense is not None and not pictured(DENSE):
            self.journal.dense = None
        for setting in list(self.journal.points):
            if not pictured(self.measurer.naming.key(setting)):
                del self.journal.points[setting]

    def _shower(self, done: int, of: int | None) -> Progress:
        """Progress of one point as a part of the total, if the total is known. It never falls, although making a scene
        has several tasks that each start at 0."""
        furthest = 0.0

        def show(what: str, share: float) -> None:
            nonlocal furthest
            furthest = max(furthest, 0.5 * share if what else 0.5 + 0.5 * share)
            if of is None:
                self.progress(f"measuring point {done + 1}", furthest)
            else:
                self.progress("measuring", min(1.0, (done + furthest) / of))

        return show

    def _take(self, point: Point, scene: Gaussians) -> None:
        """Keep a point and its scene for the page, and log its figures."""
        if self._frame is not None:
            keep_flight(self._frame, scene, point.label, flight_path(self.folder, point.key))
        self.journal.add(point)
        dense = self.journal.dense
        figures = [] if point.by == DENSE else [f"{point.against_dense.psnr:.1f} dB against the dense scene"]
        figures += [f"{point.against_photos.psnr:.2f} dB against photos"] if point.against_photos is not None else []
        figures += [str(speed_of(point, dense))] if dense is not None and point is not dense else []
        figures += [f"{point.frame_ms:.3g} ms a frame", bytes_text(point.bytes)]
        logger.info("%s: %s", point.label, ", ".join(figures))
