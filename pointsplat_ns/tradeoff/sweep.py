"""Measures a table of settings, one after the other, and writes each point as soon as it is measured."""

from __future__ import annotations

import hashlib
import itertools
import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from pointsplat_ns.errors import DataError, PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.io.pictures import write_picture
from pointsplat_ns.looking.sizes import size_text
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.pruning import Keep, method_named, parse_keep, resolve_keep
from pointsplat_ns.rasterizer import render
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.front import recommend
from pointsplat_ns.tradeoff.machine import busy_note, machine_text
from pointsplat_ns.tradeoff.measuring import Measurer, Subject
from pointsplat_ns.tradeoff.points import Point, Tradeoff, picture_path
from pointsplat_ns.tradeoff.results import SWEEP_FILES, read_points, write_points, write_table
from pointsplat_ns.tradeoff.settings import DENSE, REPAIRS, Setting, check_repairs, whole_of
from pointsplat_ns.views import spread_indices

logger = logging.getLogger("pointsplat_ns")

KEEP = ("70%", "50%", "30%", "20%", "10%", "5%")
"""Budgets of a sweep, unless others are named."""

PICTURED = 6
"""Largest number of views with pictures."""


@dataclass(frozen=True)
class SweepOptions:
    """Options of a sweep. Raises PointSplatError if an option is invalid."""

    keep: tuple[Keep | str, ...] = KEEP
    by: tuple[str, ...] = ("merge",)
    sh: tuple[str, ...] = ("all",)
    """SH degrees: "all" keeps all bands, a digit those up to a degree."""
    repairs: tuple[str, ...] = ("none", "quick")
    within: float = 0.5
    """Largest loss of the recommended point, dB."""
    views: int = VIEW_COUNTS.compared
    """Largest number of views."""

    def __post_init__(self) -> None:
        if not 0 < self.within < math.inf:
            raise PointSplatError(f"a loss of {self.within:g} dB; expected a positive number, such as 0.5")
        if self.views < 1:
            raise PointSplatError(f"{self.views} views; expected at least one")
        if not self.keep or not self.by:
            raise PointSplatError("no budget or no method is named; expected at least one of each, such as 10%, merge")
        for budget in self.keep:
            if isinstance(budget, str):
                parse_keep(budget)
        for method in self.by:
            method_named(method)
        if not self.sh or not set(self.sh) <= {"all", "0", "1", "2", "3"}:
            raise PointSplatError(f"sh is {', '.join(self.sh) or 'empty'}; expected some of all, 0, 1, 2, 3")
        check_repairs(self.repairs)

    def settings(self, dense: Gaussians) -> list[Setting]:
        """All combinations for a scene, each once. Raises BudgetError if a budget does not fit it."""
        degrees = (dense.sh_degree if sh == "all" else min(int(sh), dense.sh_degree) for sh in self.sh)
        ways = itertools.product(self.by, degrees, self.keep, check_repairs(self.repairs))
        return list(
            dict.fromkeys(
                Setting(resolve_keep(len(dense), keep, degree, dense.traits), degree, repair, by)
                for by, degree, keep, repair in ways
            )
        )


class Sweep:
    """Measures settings of a scene, and writes points, pictures and results to a folder. Raises SceneError if no
    Gaussian can be drawn, or the folder holds points of another sweep, and DataError if there is no view.

    Args:
        subject: the scene.
        sha256: hash of its file.
        folder: its results, which are gone on from.
        options: of the sweep.
        progress: called with the task and its share done.
        force: start over.
    """

    def __init__(
        self,
        subject: Subject,
        sha256: str,
        folder: Path,
        options: SweepOptions,
        progress: Progress,
        force: bool = False,
    ):
        self.subject, self.folder, self.options, self.progress = subject, folder, options, progress
        self.measurer = Measurer(subject, options.views, progress)
        self.machine = machine_text(subject.dense.device)
        judged = self.measurer.judged_views
        self._pictured = spread_indices(len(judged.views), PICTURED)
        cameras = judged.views.viewmats.numpy().tobytes() + judged.views.Ks.numpy().tobytes()
        self.identity: dict[str, str | int] = {
            "scene": sha256,
            "machine": self.machine,
            "views": judged.origin,
            "number of views": len(judged.views),
            "width": judged.views.width,
            "height": judged.views.height,
            "resolution": "" if subject.resolution is None else size_text(subject.resolution),
            # Sampled ones may differ by rounding.
            "cameras": "" if subject.new_views().given is None else hashlib.sha256(cameras).hexdigest()[:16],
        }
        self.dense = whole_of(subject.dense, DENSE)
        """The setting of the dense scene's point."""
        self.points: dict[Setting, Point] = {}
        for setting, point in ({} if force else read_points(folder, self.identity)).items():
            names = subject.names(setting)  # keys name files, so they are not taken from this one
            needed = self._pictures(names["key"])
            needed += self._pictures("photo") if setting == self.dense and judged.photos is not None else []
            if all(path.is_file() for path in needed):
                self.points[setting] = replace(point, key=names["key"], label=names["label"], command=names["command"])
        if self.dense in self.points:
            self.measurer.dense_ms = self.points[self.dense].frame_ms

    def run(self) -> Tradeoff:
        """Measure the table, and write the results; on Ctrl-C or another signal, those so far."""
        settings = self.options.settings(self.subject.dense)
        with self.finished_early():
            for number, setting in enumerate([self.dense, *settings]):
                self.measure(setting, (number, 1 + len(settings)))
        return self.finish()

    @contextmanager
    def finished_early(self) -> Iterator[None]:
        """Write the results of a sweep that an interruption ends, if there are any."""
        try:
            yield
        except (KeyboardInterrupt, SystemExit):
            if self.dense in self.points:
                self.measurer.note("the sweep was interrupted: the same command continues it")
                self.finish()
            raise

    def measure(self, setting: Setting, part: tuple[int, int] | None = None) -> Point:
        """The point of a setting, measured and written if it is missing. ``part`` is its number in the table and the
        length of the table; None if it is not of a table."""
        if setting not in self.points:
            show = self._shower(part)
            if setting == self.dense:
                scene, point = self.subject.dense, self.measurer.measure_dense(show)
            else:
                point, scene = self.measurer.measure(setting, show), self.scene(setting)
            self._keep(setting, point, scene)
        return self.points[setting]

    def scene(self, setting: Setting) -> Gaussians:
        """The scene of a setting other than the dense one; the latest scenes are kept."""
        return self.measurer.made(setting, self.progress).scene

    def finish(self, recommended: Point | None = None, why: str = "") -> Tradeoff:
        """Write and return the results; arguments as for :meth:`result`."""
        from pointsplat_ns.tradeoff.page import flight_beside, write_sweep_page

        self.progress("writing results", 0.0)
        result = self.result(recommended, why)
        write_points(result, self.identity, self.folder)
        write_table(result, self.folder)
        flight = None
        if self._frame is not None:
            flight = flight_beside(self._frame, self.folder, DENSE, result.recommended)
        write_sweep_page(result, self.folder, self.folder / SWEEP_FILES.page, flight, self.progress)
        return result

    def result(self, recommended: Point | None = None, why: str = "") -> Tradeoff:
        """All points so far: the dense scene first, the others by size. By default the recommended point and the line
        of text on it are those of :func:`~pointsplat_ns.tradeoff.front.recommend`."""
        settings = sorted(
            self.points, key=lambda s: (s != self.dense, -s.count, -s.sh_degree, REPAIRS.index(s.repair), s.by)
        )
        points = tuple(self.points[setting] for setting in settings)
        busy, judged = busy_note([point.others_cores for point in points]), self.measurer.judged_views
        if recommended is None:
            recommended, why = recommend(points, self.options.within, trusted=not busy)
        return Tradeoff(
            scene=self.subject.name,
            machine=self.machine,
            views_origin=judged.origin,
            width=judged.views.width,
            height=judged.views.height,
            points=points,
            notes=(*([busy] if busy else []), *self.measurer.notes),
            times_trusted=not busy,
            within=self.options.within,
            recommended=recommended.key,
            why=why,
        )

    @cached_property
    def _frame(self) -> FlightFrame | None:
        """The frame of flights; None if no Gaussian of the dense scene is visible."""
        try:
            return FlightFrame.of(self.subject.dense, self.measurer.judged_views.views)
        except DataError:
            return None

    def _pictures(self, key: str) -> list[Path]:
        return [picture_path(self.folder, number, key) for number in range(len(self._pictured))]

    def _keep(self, setting: Setting, point: Point, scene: Gaussians) -> None:
        """Write the pictures and the scene of a point for the page, and then the points so far."""
        from pointsplat_ns.tradeoff.page import keep_scene

        judged = self.measurer.judged_views
        for path, photo, index in zip(self._pictures(point.key), self._pictures("photo"), self._pictured, strict=True):
            write_picture(render(scene.detach(), judged.views[index]), path)
            if judged.photos is not None and setting == self.dense:
                write_picture(judged.photos[index], photo)
        if self._frame is not None:
            keep_scene(self._frame, scene, point, self.folder)
        self.points[setting] = point
        write_points(self.result(), self.identity, self.folder)
        figures = [] if setting == self.dense else [f"{point.against_dense.psnr:.1f} dB against the dense scene"]
        figures += [] if point.against_photos is None else [f"{point.against_photos.psnr:.2f} dB against photos"]
        logger.info("%s: %s", point.label, ", ".join([*figures, bytes_text(point.bytes)]))

    def _shower(self, part: tuple[int, int] | None) -> Progress:
        """Progress of one point as a part of the table. It never falls, although making a scene has several tasks that
        each start at 0."""
        furthest = 0.0

        def show(what: str, share: float) -> None:
            nonlocal furthest
            furthest = max(furthest, 0.5 * share if what else 0.5 + 0.5 * share)
            if part is None:
                self.progress(f"measuring point {1 + len(self.points)}", furthest)
            else:
                self.progress("measuring", (part[0] + furthest) / part[1])

        return show
