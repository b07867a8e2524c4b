"""Measures a table of settings, or searches for targets, and writes each point as soon as it is measured."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from pointsplat_ns.compression.posed_scene import check_photos
from pointsplat_ns.compression.quality import decibels
from pointsplat_ns.errors import BudgetError, DataError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.io.outputs import need_folder
from pointsplat_ns.io.pictures import write_picture
from pointsplat_ns.io.scene import save, source_file
from pointsplat_ns.looking.sizes import size_text
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.nerfstudio_plugin.dataset_views import need_named_data, run_photos
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.pruning import Keep
from pointsplat_ns.rasterizer import render
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.tradeoff.making import Subject, check_options, settings_of, subject_at
from pointsplat_ns.tradeoff.measuring import Measurer, busy_note, machine_text
from pointsplat_ns.tradeoff.points import (
    DENSE,
    REPAIRS,
    RESULTS,
    Point,
    Repair,
    Setting,
    Tradeoff,
    check_folder,
    picture_path,
    read_points,
    write_points,
    write_table,
)
from pointsplat_ns.tradeoff.recommend import recommend
from pointsplat_ns.tradeoff.search import Targets, TargetSearch, targets_of
from pointsplat_ns.views import spread_indices

logger = logging.getLogger("pointsplat_ns")

KEEP = ("70%", "50%", "30%", "20%", "10%", "5%")
"""Budgets of a sweep, unless others are named."""

PICTURED = 6
"""Largest number of views with pictures."""


@normal_mode
def measure_tradeoff(
    scene: str | Path,
    folder: str | Path,
    *,
    keep: Sequence[Keep | str] | None = None,
    within: float = 0.5,
    by: tuple[str, ...] = ("merge",),
    sh: tuple[str, ...] = ("all",),
    repairs: tuple[str, ...] = ("none", "quick"),
    views: int = VIEW_COUNTS.compared,
    poses: str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    photos: str | Path | None = None,
    target_db: float | None = None,
    target_ms: float | None = None,
    target_mb: float | None = None,
    force: bool = False,
    progress: bool | Progress = False,
) -> Tradeoff:
    """Measure how a scene trades quality for frame time, size and count, on this machine.

    It measures each method, SH degree and repair at each budget. Or, with targets, it searches for the cheapest scene
    that meets all of them and writes it; among limits of time and size alone, for the best one within them. Each point
    is saved as soon as it is measured: the same call resumes after an interruption.

    Args:
        scene: a PLY, a checkpoint, or a Splatfacto run, whose held-out photos are then used where they are found.
        folder: where points, pictures, the table, the page and the found scene go.
        keep: budgets, as for :func:`pointsplat_ns.prune`, but for a PSNR; by default six from 70 % to 5 %.
        within: the recommended point is the fastest that loses at most so much, dB: against photos, or as much as is
            expected of its renders (:mod:`~pointsplat_ns.tradeoff.recommend`).
        by: methods, as for :func:`pointsplat_ns.prune`; a search uses the first one.
        sh: SH degrees: "all" for all bands, a digit for those up to a degree.
        repairs: some of "none", "refiner", "quick" and "thorough", the efforts of :func:`pointsplat_ns.compact`, and
            "photos", its training on the photos.
        views: largest number of views that are timed, and of photos; without photos at most 12.
        poses: a file of cameras to look from, as ``views`` of :func:`pointsplat_ns.prune`; no photos are used then,
            unless they are named.
        resolution: as for :func:`pointsplat_ns.prune`. Scenes are judged in pictures of this size, as by every
            command. Frames are timed, and pictures drawn, at a middle size, of 784 x 441 pixels for 1920 x 1080; photos
            are reduced to it.
        up: as for :func:`pointsplat_ns.prune`.
        data, photos: as for :func:`pointsplat_ns.prune`; the photos of a run are used anyway.
        target_db: least PSNR against the dense scene's renders, over the pixels that it covers, dB.
        target_ms: longest time of a frame, milliseconds.
        target_mb: largest file, in units of 10^6 bytes.
        force: start over, and overwrite results in the folder.
        progress: True shows a bar; a function is called with the task and its share done.

    Returns:
        Every point of the folder, and the recommended or found one: see :class:`Tradeoff`.

    Raises:
        BudgetError: if no scene meets the targets, or a budget or a target means nothing.
        SceneError: if the scene or the folder is not usable, or the folder holds points of another sweep.
        DataError: if there is no view, or most of those of ``poses`` see nothing of the scene.
        PointSplatError: if there is no such method or repair, or a number means nothing.
        KeyboardInterrupt: after the results of an interrupted sweep were written.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::200][:300], f"{folder}/room.ply")
        ...     options = {"repairs": ("none",), "views": 2, "resolution": "64x48"}
        ...     found = ps.measure_tradeoff(f"{folder}/room.ply", f"{folder}/trade", target_mb=0.01, **options)
        >>> found.point(found.recommended).bytes <= 10_000
        True
    """
    budgets = KEEP if keep is None else tuple(keep)
    tried = check_options(budgets, tuple(by), tuple(sh), tuple(repairs), within, views)
    targets = targets_of(target_db, target_ms, target_mb, keep, " ".join(sh), photos="photos" in tried)
    path, folder = Path(scene), Path(folder)
    need_named_data(path, data)
    need_folder(folder)
    if not force:
        check_folder(folder)
    with progress_bar(progress) as report:
        own, trained = None if photos is None else Path(photos), "photos" in tried
        subject = subject_at(path, poses, resolution, up, data, own, report, trained)
        if trained and own is None:
            training = run_photos(path, "train", data)
            check_photos(subject.dense, training, path)
            subject = replace(subject, training=training)
        sweep = Sweep(subject, source_file(path).sha256, folder, report, within, views, force)
        if targets is not None:
            return sweep.search(targets, by[0], tried)
        return sweep.run(settings_of(subject.dense, budgets, by, sh, tried))


class Sweep:
    """Measures settings of a scene, and writes points, pictures and results to a folder.

    Args:
        subject: the scene.
        sha256: hash of its file.
        folder: its results, from which it resumes.
        progress: called with the task and its share done.
        within: largest loss of the recommended point, dB.
        views: largest number of views.
        force: start over.

    Raises:
        SceneError: if no Gaussian can be drawn, or the folder holds points of another sweep.
        DataError: if there is no view.
    """

    def __init__(
        self,
        subject: Subject,
        sha256: str,
        folder: Path,
        progress: Progress,
        within: float = 0.5,
        views: int = VIEW_COUNTS.compared,
        force: bool = False,
    ):
        self.subject, self.folder, self.progress, self.within, self.force = subject, folder, progress, within, force
        self.measurer = Measurer(subject, views, progress)
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
            "judged in": self.measurer.judge.where,
            "resolution": "" if subject.resolution is None else size_text(subject.resolution),
            # Sampled ones may differ by rounding.
            "cameras": "" if subject.new_views().given is None else hashlib.sha256(cameras).hexdigest()[:16],
        }
        self.dense = Setting(len(subject.dense), subject.dense.sh_degree, by=DENSE)
        """The setting of the dense scene's point."""
        self.points: dict[Setting, Point] = {}
        for setting, point in ({} if force else read_points(folder, self.identity)).items():
            names = subject.names(setting)  # keys name files, so they are not taken from this one
            needed = self._pictures(names["key"])
            needed += self._pictures("photo") if setting == self.dense and judged.photos is not None else []
            if all(path.is_file() for path in needed):
                self.points[setting] = replace(point, **names)
        if self.dense in self.points:
            self.measurer.dense_ms = self.points[self.dense].frame_ms

    def run(self, settings: Sequence[Setting]) -> Tradeoff:
        """Measure the dense scene and a table of settings, and write the results; on Ctrl-C or another signal, those so
        far."""
        with self._finished_early():
            for number, setting in enumerate((self.dense, *settings), start=1):
                self.measure(setting, f"point {number} of {1 + len(settings)}")
        return self.finish()

    def search(self, targets: Targets, by: str, repairs: tuple[Repair, ...]) -> Tradeoff:
        """Search for the cheapest scene that meets targets with a method and the repairs to try, and write it beside
        the results. Raises BudgetError if there is none, after the results were written."""
        measurer = self.measurer
        with self._finished_early():
            self.measure(self.dense)
            whole, where = replace(self.dense, by=by), measurer.judge.where
            search = TargetSearch(targets, whole, repairs, self.measure, measurer.cut_psnr, where)
            try:
                found = search.run()
            except BudgetError:
                self.finish()  # what was measured on the way
                raise
        output = self.folder / f"{self.subject.name}_{found.point.key}.ply"
        if not output.exists() or self.force:
            save(measurer.made(found.setting, self.progress).scene, output, overwrite=True)
        return self.finish(found.point, f"{found.why}; written to {output}", str(targets))

    @contextmanager
    def _finished_early(self) -> Iterator[None]:
        """Write the results of a sweep that an interruption ends, if there are any."""
        try:
            yield
        except (KeyboardInterrupt, SystemExit):
            if self.dense in self.points:
                self.measurer.note("the sweep was interrupted: the same command continues it")
                self.finish()
            raise

    def measure(self, setting: Setting, name: str = "") -> Point:
        """The point of a setting, measured and written if it is missing. ``name`` is for the progress."""
        if setting not in self.points:
            name = name or f"point {1 + len(self.points)}"

            def show(what: str, share: float) -> None:
                self.progress(f"{name}: {what}", share)

            if setting == self.dense:
                scene, point = self.subject.dense, self.measurer.measure_dense(show)
            else:
                point, scene = self.measurer.measure(setting, show), self.measurer.made(setting, show).scene
            self._keep(setting, point, scene)
        return self.points[setting]

    def finish(self, recommended: Point | None = None, why: str = "", target: str = "") -> Tradeoff:
        """Write and return the results; arguments as for :meth:`result`."""
        from pointsplat_ns.tradeoff.page import flight_beside, write_sweep_page

        self.progress("writing results", 0.0)
        result = self.result(recommended, why, target)
        write_points(result, self.identity, self.folder)
        write_table(result, self.folder)
        flight = None
        if self._frame is not None:
            flight = flight_beside(self._frame, self.folder, DENSE, result.recommended)
        write_sweep_page(result, self.folder, self.folder / RESULTS["page"], flight, self.progress)
        return result

    def result(self, recommended: Point | None = None, why: str = "", target: str = "") -> Tradeoff:
        """All points so far: the dense scene first, the others by size. By default the recommended point and the text
        on it are those of :func:`~pointsplat_ns.tradeoff.recommend.recommend`."""
        settings = sorted(
            self.points, key=lambda s: (s != self.dense, -s.count, -s.sh_degree, REPAIRS.index(s.repair), s.by)
        )
        points = tuple(self.points[setting] for setting in settings)
        busy, judged = busy_note([point.others_cores for point in points]), self.measurer.judged_views
        if recommended is None:
            recommended, why = recommend(points, self.within, trusted=not busy)
        return Tradeoff(
            scene=self.subject.name,
            machine=self.machine,
            views_origin=judged.origin,
            width=judged.views.width,
            height=judged.views.height,
            judged_in=self.measurer.judge.where,
            points=points,
            notes=(*([busy] if busy else []), *self.measurer.notes),
            times_trusted=not busy,
            within=self.within,
            recommended=recommended.key,
            why=why,
            target=target,
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
                write_picture(judged.photos[index].target, photo)
        if self._frame is not None:
            keep_scene(self._frame, scene, point, self.folder)
        self.points[setting] = point
        write_points(self.result(), self.identity, self.folder)
        figures = [] if point.against_photos is None else [f"{point.against_photos.psnr:.1f} dB against photos"]
        figures += [] if setting == self.dense else [f"{decibels(point.against_dense.psnr)} against the dense scene"]
        logger.info("%s: %s", point.label, ", ".join([*figures, bytes_text(point.bytes)]))
