"""Measures what a scene in hand loses and gains when it gets smaller."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from pointsplat_ns.compression.posed_scene import NO_POSES, check_photos, read_found, without_poses
from pointsplat_ns.compression.trained_refiner import TrainedRefiner
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.outputs import claimed_folder
from pointsplat_ns.io.runs import may_be_run, name_of
from pointsplat_ns.io.scene import save
from pointsplat_ns.io.source import source_file
from pointsplat_ns.looking.sizes import parse_resolution, size_text
from pointsplat_ns.looking.upright import Up, up_named
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.nerfstudio_plugin.dataset_views import (
    dataset_photos,
    need_named_data,
    training_photos,
    view_source,
)
from pointsplat_ns.pruning import Keep
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.tradeoff.measuring import Subject
from pointsplat_ns.tradeoff.points import Tradeoff
from pointsplat_ns.tradeoff.results import check_folder
from pointsplat_ns.tradeoff.search import TargetSearch
from pointsplat_ns.tradeoff.settings import check_repairs, whole_of
from pointsplat_ns.tradeoff.sweep import KEEP, Sweep, SweepOptions
from pointsplat_ns.tradeoff.targets import Targets, targets_of
from pointsplat_ns.views import Views


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
            expected of its renders (:mod:`~pointsplat_ns.tradeoff.front`).
        by: methods, as for :func:`pointsplat_ns.prune`; a search uses the first one.
        sh: SH degrees: "all" for all bands, a digit for those up to a degree.
        repairs: some of "none", "refiner", "quick" and "thorough", the efforts of :func:`pointsplat_ns.compact`, and
            "photos", its training on the photos of a run.
        views: largest number of views; without photos at most 12.
        poses: a file of cameras to look from, as ``views`` of :func:`pointsplat_ns.prune`; no photos are used then.
        resolution: as for :func:`pointsplat_ns.prune`. Scenes are judged and timed in the pictures that
            :func:`pointsplat_ns.compact` compares in, of 784 x 441 pixels for 1920 x 1080; photos are reduced to them.
        up: as for :func:`pointsplat_ns.prune`.
        data: as for :func:`pointsplat_ns.prune`.
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
    options = SweepOptions(KEEP if keep is None else tuple(keep), tuple(by), tuple(sh), tuple(repairs), within, views)
    on_photos = "photos" in options.repairs
    targets = targets_of(target_db, target_ms, target_mb, keep, " ".join(sh), photos=on_photos)
    path, folder = Path(scene), Path(folder)
    need_named_data(path, data)
    with claimed_folder(folder), progress_bar(progress) as report:
        if not force:
            check_folder(folder)
        subject = _subject_at(path, poses, resolution, up, data)
        if on_photos:
            training = training_photos(path, data)
            check_photos(subject.dense, training, path)
            subject = replace(subject, training=training)
        sweep = Sweep(subject, source_file(path).sha256, folder, options, report, force)
        return sweep.run() if targets is None else _search(sweep, targets, force)


def _search(sweep: Sweep, targets: Targets, force: bool) -> Tradeoff:
    """Measure what a search for targets asks for, and write the found scene beside the results."""
    options, measurer = sweep.options, sweep.measurer
    whole, repairs = whole_of(measurer.dense, options.by[0]), check_repairs(options.repairs)
    with sweep.finished_early():
        sweep.measure(sweep.dense)
        search = TargetSearch(targets, whole, repairs, sweep.measure, measurer.cut_psnr, measurer.judged_views.where)
        try:
            found = search.run()
        except BudgetError:
            sweep.finish()  # what was measured on the way
            raise
    output = sweep.folder / f"{sweep.subject.name}_{found.point.key}.ply"
    if not output.exists() or force:
        save(sweep.scene(found.setting), output)
    return sweep.finish(found.point, f"{found.why}; written to {output}")


def _subject_at(
    path: Path,
    poses: str | Path | None,
    resolution: tuple[int, int] | str | None,
    up: str | None,
    data: str | Path | None,
) -> Subject:
    """The scene at a path, with the options on views that its commands repeat."""
    size, upward, sampled = parse_resolution(resolution), up_named(up), without_poses(poses)
    dense, given, file = read_found(path, poses)
    subject = subject_of(dense, None if sampled else path, given, resolution=size, up=upward, data=data)
    named = {
        "--poses": NO_POSES if sampled else file,
        "--resolution": None if size is None else size_text(size),
        "--data": data,
    }
    words = [word for option, value in named.items() if value is not None for word in (option, str(value))]
    words += [] if up is None else [f"--up={up}"]
    return replace(subject, path=path, name=name_of(path), words=tuple(words))


def subject_of(
    dense: Gaussians,
    run: Path | None,
    views: Views | None = None,
    refiner: TrainedRefiner | None = None,
    suffix: str = ".ply",
    resolution: tuple[int, int] | None = None,
    up: Up | None = None,
    data: str | Path | None = None,
) -> Subject:
    """A scene to be measured, with the views that its commands have and its held-out photos.

    Args:
        dense: the scene.
        run: the file or folder whose dataset may have the poses and photos; None if it is in memory only, or views are
            to be sampled.
        views: given ones, in place of any others; there are no photos of them.
        refiner: what repairs begin with; by default nothing, and the one that ships where it repairs alone.
        suffix: of the format that smaller scenes are written in.
        resolution, up: as for :class:`~pointsplat_ns.looking.view_source.ViewSource`.
        data: where the data of the run is now, if it moved.
    """
    held_out = None
    if run is not None and views is None and may_be_run(run):
        held_out = functools.partial(dataset_photos, run, "test", data=data)
    return Subject(
        dense=dense,
        path=run or Path("scene.ply"),
        name="scene",
        new_views=lambda: view_source(dense, views, run, data, resolution, up),
        held_out=held_out,
        refiner=refiner,
        suffix=suffix,
        resolution=resolution,
    )
