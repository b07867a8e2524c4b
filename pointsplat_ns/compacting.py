"""Reads a scene and runs one request on it: shared by the public functions and the commands."""

from __future__ import annotations

import functools
import logging
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.compression.posed_scene import NO_POSES, check_photos, read_found, without_poses
from pointsplat_ns.compression.requests import CompactRequest, PruneRequest
from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.sizes import parse_resolution
from pointsplat_ns.looking.upright import up_named
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.views import Views

if TYPE_CHECKING:
    from pointsplat_ns.compression.compact import Compacted
    from pointsplat_ns.compression.photo_repair import Photos
    from pointsplat_ns.compression.quality import FullSizeQuality
    from pointsplat_ns.compression.requests import Effort
    from pointsplat_ns.tradeoff.search import Targets

logger = logging.getLogger("pointsplat_ns")

Source = Gaussians | str | Path
"""A dense scene, or its path."""

ViewsInput = Views | str | Path | None
"""Views, the run whose dataset has the poses, a file of cameras, None for those of the scene's run or of a file of
cameras that lies beside the scene, or "none" for sampled ones."""

ResolutionInput = tuple[int, int] | str | None
"""Width and height of pictures, pixels."""

DataInput = str | Path | None
"""Where the data of a run is now, if it moved: the data itself, or a folder above it."""


@dataclass(frozen=True)
class Goal:
    """The goal of a search for the cheapest scene."""

    targets: Targets
    effort: Effort
    """Effort of repairs."""
    suffix: str
    """Suffix of the format whose size counts."""


@normal_mode
def prune_source(
    scene: Source,
    request: PruneRequest,
    views: ViewsInput = None,
    resolution: ResolutionInput = None,
    up: str | None = None,
    data: DataInput = None,
    progress: bool | Progress = False,
    compared: str = "",
) -> tuple[Gaussians, Gaussians, float, FullSizeQuality | None]:
    """Read a scene and prune it; notes are logged. Arguments as of :func:`pointsplat_ns.prune`.

    Returns:
        The dense scene, the smaller scene, the seconds of pruning, and how close both are, if ``compared`` is the
        suffix of the file to be written; None if there are no views.
    """
    from pointsplat_ns.compression.prune import prune_scene
    from pointsplat_ns.compression.quality import quality_of_pruned

    dense, source = read_source(scene, views, resolution, up, data)
    start = time.perf_counter()
    with progress_bar(progress) as report:
        pruned = prune_scene(dense, request, source, report)
        seconds, quality = time.perf_counter() - start, None
        if compared:
            quality = _as_written(lambda scene: quality_of_pruned(dense, scene, pruned, source), pruned.scene, compared)
    log(pruned.notes)
    return dense, pruned.scene, seconds, quality


@normal_mode
def compact_source(
    scene: Source,
    request: CompactRequest,
    goal: Goal | None = None,
    views: ViewsInput = None,
    resolution: ResolutionInput = None,
    up: str | None = None,
    data: DataInput = None,
    progress: bool | Progress = False,
    compared: str = "",
) -> tuple[Gaussians, Compacted, FullSizeQuality | None]:
    """Read a scene and compact it, or search for a goal; verdicts and notes are logged. Arguments as of
    :func:`pointsplat_ns.compact`. A search uses only the method and the refiner of the request, and decides the rest.

    Returns:
        The dense scene, the result, and how close both are at full size, in the views that no repair uses, if
        ``compared`` is the suffix of the file to be written; None if there are no views.
    """
    from pointsplat_ns.compression.quality import quality_if_seen

    dense, source = read_source(scene, views, resolution, up, data)
    with progress_bar(progress) as report:
        if goal is None:
            from pointsplat_ns.compression.compact import compact_scene

            photos = None if request.photos is None else _training_photos(run_of(scene, None), data)
            if photos is not None:
                check_photos(dense, photos, str(scene))
            result = compact_scene(dense, request, source, report, photos)
        else:
            from pointsplat_ns.tradeoff.making import subject_of
            from pointsplat_ns.tradeoff.points import repairs_of
            from pointsplat_ns.tradeoff.search import find_scene

            size, upward = parse_resolution(resolution), up_named(up)
            run = run_of(scene, views)
            subject = subject_of(dense, run, source.given, request.refiner, goal.suffix, size, upward, data)
            result = find_scene(subject, goal.targets, request.prune.by, repairs_of(goal.effort), report)
        quality = None
        if compared:
            quality = _as_written(lambda scene: quality_if_seen(dense, scene, source.whole), result.scene, compared)
    log((*result.notes, *result.verdict.splitlines(), *result.target.splitlines()))
    return dense, result, quality


def _as_written(
    quality_of: Callable[[Gaussians], FullSizeQuality | None], scene: Gaussians, suffix: str
) -> FullSizeQuality | None:
    """Quality of a scene; where it does not differ from the dense scene, that of its file, which may round numbers."""
    from pointsplat_ns.tradeoff.making import through_file

    quality = quality_of(scene)
    if quality is not None and quality.psnr == math.inf:
        written = through_file(scene, suffix)[1]
        quality = quality if written is scene else quality_of(written)
    return quality


def goal_of(
    request: CompactRequest,
    keep: object,
    db: float | None,
    ms: float | None,
    mb: float | None,
    suffix: str,
) -> Goal | None:
    """The goal of a search, from a PSNR against the dense scene's renders in dB, the time of a frame in milliseconds
    and the size of a file of a format in units of 10^6 bytes; None if no target is given. Raises BudgetError if a
    target is not positive, or an option was given that a search decides, such as ``keep``."""
    from pointsplat_ns.tradeoff.search import targets_of

    pruning, photos = request.prune, request.photos is not None
    targets = targets_of(db, ms, mb, keep, pruning.sh, pruning.clean, request.repair.seconds, photos)
    return None if targets is None else Goal(targets, request.repair.effort, suffix)


def read_source(
    scene: Source,
    views: ViewsInput,
    resolution: ResolutionInput,
    up: str | None = None,
    data: DataInput = None,
) -> tuple[Gaussians, ViewSource]:
    """Read the dense scene, and make its source of views. Arguments as of :func:`pointsplat_ns.prune`. Raises
    SceneError if a file is missing or damaged, or the scene is a ``pointsplat`` run, which is pruned already; DataError
    if a file of cameras is not usable, or most of them see nothing of the scene; and PointSplatError if the resolution
    or ``up`` is not valid."""
    size, upward = parse_resolution(resolution), up_named(up)
    if data is not None:
        from pointsplat_ns.nerfstudio_plugin.dataset_views import need_named_data

        need_named_data(scene if views is None or without_poses(views) else views, data)
    poses: Path | str | None = None if views is None else NO_POSES
    if isinstance(views, (str, Path)) and not without_poses(views):
        from pointsplat_ns.io.camera_files import is_camera_file

        if not Path(views).exists():
            raise SceneError(
                f"{views}: no such file or folder; expected views, a run whose dataset has the poses, or a file of "
                "cameras"
            )
        poses = views if is_camera_file(views) else NO_POSES
    dense, found, _ = read_found(scene, poses)
    given = views if isinstance(views, Views) else found
    read = functools.partial(_dataset_views, data=data)
    return dense, ViewSource(dense, given, run_of(scene, views), read, size, up=upward)


def run_of(scene: Source, views: ViewsInput) -> Path | None:
    """The file or folder whose dataset may have the poses; None if views are to be sampled."""
    if without_poses(views):
        return None
    named = scene if views is None else views
    return Path(named) if isinstance(named, (str, Path)) else None


def _training_photos(run: Path | None, data: DataInput) -> Photos:
    """The training photos of a run's dataset.

    Raises:
        SceneError: if there is no run.
        DataError: if its data is not found.
    """
    if run is None:
        raise SceneError("photos are read from the dataset of a run; expected the path of a run")
    from pointsplat_ns.nerfstudio_plugin.dataset_views import training_photos

    return training_photos(run, data)


def log(lines: tuple[str, ...]) -> None:
    """Log lines of text at level INFO."""
    for line in lines:
        logger.info("%s", line)


def _dataset_views(run: Path | str, data: DataInput = None) -> Views:
    """The poses of a run's dataset. Read by the plugin, which is not imported before."""
    from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views

    return dataset_views(run, data=data)
