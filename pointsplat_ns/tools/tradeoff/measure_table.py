"""Measures a table of budgets, methods and repairs, and writes it as JSON and as a page."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.pipeline.options import ViewOptions
from pointsplat_ns.pruning import Keep, method_named, parse_keep, resolve_keep
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import name_of
from pointsplat_ns.scene.views import ImageSize, sizes_text, spread_indices
from pointsplat_ns.system.files import (
    bytes_text,
    logger,
    need_folder,
    need_new,
    replacing,
    three_digits,
)
from pointsplat_ns.system.outputs import outputs_claimed
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.tools.pages.html import page
from pointsplat_ns.tools.pages.image_encoding import picture_uri, to_uint8
from pointsplat_ns.tools.tradeoff.measured_scene import make, subject_at
from pointsplat_ns.tools.tradeoff.measuring import Measurer, busy_note, machine_text
from pointsplat_ns.tools.tradeoff.points import (
    DENSE,
    QUICK,
    REPAIRS,
    RESULTS,
    WHOLE,
    ImageMetrics,
    Point,
    Setting,
    Tradeoff,
    write_points,
)
from pointsplat_ns.tools.tradeoff.recommend import next_best, recommend
from pointsplat_ns.tools.wording import (
    QUICK_NOTE,
    decibels,
    impression,
    tradeoff_estimate,
    views_of_size,
)


@normal_mode
@outputs_claimed()
def measure_tradeoff(
    scene: str | Path,
    folder: str | Path,
    *,
    keep: Sequence[Keep | str] | None = None,
    within: float = 0.5,
    by: Sequence[str] = ("merge",),
    repairs: Sequence[str] | None = None,
    views: int | None = None,
    quick: bool = False,
    poses: str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    photos: str | Path | None = None,
    force: bool = False,
    progress: bool | Progress = False,
) -> Tradeoff:
    """Measure how a scene trades quality for frame time, size and count on this machine, for all
    combinations of budgets, methods and repairs.

    Args:
        scene: a PLY, a checkpoint, or a Splatfacto run, whose held-out photos are used if
            available.
        folder: output folder for the figures (JSON) and the page.
        keep: budgets, as for :func:`pointsplat_ns.prune` except a PSNR; by default 70, 50, 30, 20,
            10 and 5 %.
        within: maximum loss of the recommended point against photos, dB. Without photos, the loss
            is estimated from renders (:mod:`~pointsplat_ns.tools.tradeoff.recommend`). The fastest
            such point is recommended.
        by: methods, as for :func:`pointsplat_ns.prune`.
        repairs: some of "none", "quick" and "thorough", the efforts of
            :func:`pointsplat_ns.compact`, and "photos", its training on the photos; by default
            "none" and "quick".
        views: maximum number of timed views and of photos, by default 12; without photos at most
            12.
        quick: by default measure only 50, 20 and 5 %, without repairs, in four views; timed and
            drawn pictures have half the width.
        poses: camera file, as ``views`` of :func:`pointsplat_ns.prune`. The photos of a run are
            then not used, unless ``photos`` is given.
        resolution: as for :func:`pointsplat_ns.prune`. Scenes are judged at this size, as by every
            command. Frames are timed and drawn at a middle size, 784 x 441 pixels for 1920 x 1080;
            photos are reduced to it.
        up: as for :func:`pointsplat_ns.prune`.
        data, photos: as for :func:`pointsplat_ns.prune`; photos of a run are used by default.
        force: overwrite results in the folder.
        progress: True shows a bar; a function is called with the task and its share done.

    Returns:
        All points, and the recommended one: see :class:`Tradeoff`.

    Raises:
        BudgetError: if a budget is invalid, or does not fit the scene.
        SceneError: if the scene or the folder is not usable.
        DataError: if there is no view, or most views of ``poses`` see nothing of the scene.
        PointSplatError: if a method or repair is unknown, or a number is invalid.
        KeyboardInterrupt: on Ctrl-C, after the results so far are written.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::200][:300], f"{folder}/room.ply")
        ...     options = {"keep": ("10%",), "repairs": ("none",), "views": 2, "resolution": "64x48"}
        ...     found = ps.measure_tradeoff(f"{folder}/room.ply", f"{folder}/trade", **options)
        >>> [point.key for point in found.points]
        ['dense', '10pct']
    """
    extent = QUICK if quick else WHOLE
    keep = extent.keep if keep is None else keep
    repairs = extent.repairs if repairs is None else repairs
    views = extent.views if views is None else views
    check_options(keep, by, repairs, within, views)
    path = Path(scene)
    folder = Path(folder)
    need_folder(folder)
    for name in RESULTS.values():
        need_new(folder / name, force)
    with progress_bar(progress) as report:
        report("looking for views", 0.0)
        own = None if photos is None else Path(photos)
        options = ViewOptions(poses=poses, resolution=resolution, up=up, data=data)
        subject = subject_at(path, options, own, report, "photos" in repairs)
        table = settings_of(subject.dense, keep, by, repairs)
        measurer = Measurer(subject, views, extent.shrink)
        seconds = measurer.expected_seconds(table)
        logger.info(tradeoff_estimate(len(table), len(subject.dense), seconds, quick))
        measuring = _Measuring(measurer, within, folder, QUICK_NOTE if quick else "")
        try:
            for number, setting in enumerate(table, start=1):

                def show(
                    task: str, share: float, name: str = f"point {number} of {len(table)}"
                ) -> None:
                    report(f"{name}: {task}", share)

                made = (subject.dense, 0.0) if setting.by == DENSE else make(subject, setting, show)
                measuring.add(setting, *made, show)
        except (KeyboardInterrupt, SystemExit):
            if measuring.points:
                measuring.write("the measurement was interrupted")
            raise
        return measuring.write()


def check_options(
    keep: Sequence[Keep | str], by: Sequence[str], repairs: Sequence[str], within: float, views: int
) -> None:
    """Raise a PointSplatError if an option is invalid."""
    if not 0 < within < math.inf:
        raise PointSplatError(f"a loss of {within:g} dB; expected a positive number, such as 0.5")
    if views < 1:
        raise PointSplatError(f"{views} views; expected at least one")
    if not keep or not by:
        raise PointSplatError(
            "no budget or no method; expected at least one of each, such as 10% and merge"
        )
    for budget in keep:
        if isinstance(budget, str):
            parse_keep(budget)
    for method in by:
        method_named(method)
    if not repairs or not {*repairs} <= {*REPAIRS}:
        raise PointSplatError(
            f"repairs: {', '.join(repairs) or 'empty'}; expected some of {', '.join(REPAIRS)}"
        )


def settings_of(
    dense: Gaussians, keep: Sequence[Keep | str], by: Sequence[str], repairs: Sequence[str]
) -> list[Setting]:
    """The dense scene, then all distinct combinations of options, the largest first."""
    counts = {resolve_keep(len(dense), budget, dense.sh_degree, dense.traits) for budget in keep}
    ordered = [repair for repair in REPAIRS if repair in repairs]
    combinations = itertools.product(sorted(counts, reverse=True), ordered, dict.fromkeys(by))
    return [Setting(len(dense), by=DENSE), *(Setting(*options) for options in combinations)]


class _Measuring:
    """The points so far, and their pictures."""

    def __init__(self, measurer: Measurer, within: float, folder: Path, note: str = ""):
        self.measurer = measurer
        self.within = within
        self.folder = folder
        self.note = note
        self.points: list[Point] = []
        self.shown = spread_indices(len(measurer.judged.views), 6)  # views with pictures
        photos = measurer.judged.photos
        self.pictures: list[dict[str, str]] = [
            {} if photos is None else {"photo": picture_uri(to_uint8(photos[index].target))}
            for index in self.shown
        ]
        """Pictures for the page by view: the photo, and the render of each point by key."""

    @torch.no_grad()
    def add(self, setting: Setting, scene: Gaussians, seconds: float, show: Progress) -> None:
        """Measure a scene, and draw it."""
        point = self.measurer.point(setting, scene, seconds, show)
        for pictures, index in zip(self.pictures, self.shown, strict=True):
            pictures[point.key] = picture_uri(
                to_uint8(render(scene, self.measurer.judged.views[index]))
            )
        self.points.append(point)

    def write(self, note: str = "") -> Tradeoff:
        """Write and return the results so far."""
        measurer = self.measurer
        busy = busy_note([point.others_cores for point in self.points])
        best, reason = recommend(self.points, self.within, trusted=not busy)
        found = Tradeoff(
            scene=name_of(measurer.subject.path),
            machine=machine_text(measurer.dense.device),
            views_origin=measurer.judged.origin,
            judged_in=views_of_size(measurer.judge.views),
            width=measurer.judged.views.width,
            height=measurer.judged.views.height,
            other_sizes=tuple(measurer.judged.views.image_sizes()[1:]),
            points=tuple(self.points),
            notes=tuple(filter(None, (busy, measurer.note, self.note, note))),
            recommended=best.key,
            why=reason,
        )
        write_points(found, self.folder)
        write_page(found, self.pictures, self.folder / RESULTS["page"])
        return found


def write_page(found: Tradeoff, pictures: Sequence[dict[str, str]], output: Path) -> None:
    """Write a self-contained HTML file with the points of a scene. ``pictures`` has, per view, data
    URIs of the render of each point by key, and of the photo as ``photo``."""
    dense = found.points[0]
    best = found.point(found.recommended)
    shown = next_best(found.points) or best if best is dense else best
    data = {
        "points": [_data(point) for point in found.points],
        "pictures": list(pictures),
        "shown": shown.key,
    }
    html = page(
        "tradeoff.html",
        ("tradeoff.js",),
        found=found,
        sizes=sizes_text([ImageSize(found.width, found.height), *found.other_sizes]),
        photos=dense.against_photos is not None,
        shown=shown,
        word_for=impression,
        three_digits=three_digits,
        infinity=math.inf,
        data=data,
    )
    with replacing(output, named=False) as part:
        part.write_bytes(html)


def _data(point: Point) -> dict[str, Any]:
    """Data of a point for scripts; None for figures that were not measured or are infinite."""

    def finite(quality: ImageMetrics | None) -> dict[str, float | None]:
        psnr = None if quality is None or quality.psnr == math.inf else quality.psnr
        return {"psnr": psnr, "ssim": None if psnr is None or quality is None else quality.ssim}

    figures = []
    if point.against_photos is not None:
        figures.append(f"{point.against_photos.psnr:.1f} dB against photos")
    if point.by != DENSE:
        figures.append(f"{decibels(point.against_dense.psnr)} against the dense scene")
    figures += [
        f"{point.speed.median:.2g} times as fast",
        f"{point.gaussians:,} Gaussians",
        bytes_text(point.bytes),
    ]
    repaired = "" if point.repair == "none" else f", repaired ({point.repair})"
    return {
        "key": point.key,
        "label": point.label,
        "command": point.command,
        "group": f"{point.by}{repaired}",
        "figures": ", ".join(figures),
        "frame_ms": point.frame_ms,
        "gaussians": point.gaussians,
        "megabytes": point.bytes / 1e6,
        "renders": finite(point.against_dense),
        "photos": finite(point.against_photos),
    }
