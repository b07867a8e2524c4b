"""Reads a scene and runs one request on it: shared by the public functions and the commands."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from pointsplat_ns.errors import DataError, PointSplatError, SceneError
from pointsplat_ns.pipeline.options import CompactRequest, PruneRequest, default_device
from pointsplat_ns.pipeline.photos.posed_scene import (
    NO_POSES,
    check_photos,
    read_found,
    without_poses,
)
from pointsplat_ns.pipeline.report import Compacted, last_kept
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewSource
from pointsplat_ns.pruning import need_usable
from pointsplat_ns.rendering.comparison.sizes import parse_resolution
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views, spread_indices
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.system.tensors import normal_mode
from pointsplat_ns.view_sampling.upright import Up, up_named

if TYPE_CHECKING:
    from pointsplat_ns.pipeline.photos.examples import Photos

logger = logging.getLogger("pointsplat_ns")

Source = Gaussians | str | Path
"""A dense scene, or its path."""


@dataclass(frozen=True, eq=False)
class Looking:
    """Options on views, as arguments of :func:`pointsplat_ns.prune`. Raises PointSplatError if the
    resolution or ``up`` is not valid."""

    views: Views | str | Path | None = None
    """Views, the run whose dataset has the poses, a file of cameras, None for those of the scene's
    run or of a file of cameras that lies beside the scene, or "none" for sampled ones."""
    resolution: tuple[int, int] | str | None = None
    """Width and height of pictures, pixels."""
    up: str | None = None
    data: str | Path | None = None
    """Where the data of a run is now, if it moved: the data itself, or a folder above it."""
    photos: Path | str | bool = False
    """Whether to read the photos of the scene's run; or a folder of photos, whose poses are those
    of ``views``, a file, or are looked for if that is None."""
    size: tuple[int, int] | None = field(init=False)
    """``resolution``, parsed."""
    upward: Up | None = field(init=False)
    """``up``, parsed."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "size", parse_resolution(self.resolution))
        object.__setattr__(self, "upward", up_named(self.up))

    def run_of(self, scene: Source) -> Path | None:
        """The file or folder whose dataset may have the poses; None if views are to be sampled."""
        named = scene if self.views is None else self.views
        return Path(named) if isinstance(named, (str, Path)) and not without_poses(named) else None


@normal_mode
def prune_source(
    scene: Source, request: PruneRequest, looking: Looking, progress: bool | Progress = False
) -> tuple[Gaussians, Gaussians, float, ViewSource]:
    """Read a scene and prune it; notes are logged as details.

    Returns:
        The dense scene, the smaller scene, the seconds of pruning, and the source of its views, to
        judge it in.
    """
    from pointsplat_ns.pipeline.prune import prune_scene

    dense, source, photos = _read_photographed(scene, looking, progress, training=False)
    start = time.perf_counter()
    with progress_bar(progress) as report:
        pruned = prune_scene(dense.to(default_device()), request, source, report)
        scene = pruned.scene.to(dense.device)
        seconds = time.perf_counter() - start
    _log_details(pruned.notes, source)
    _log_held_out(dense, (scene,), photos)
    return dense, scene, seconds, source


def clean(
    scene: Source,
    strength: float = 0.5,
    *,
    picture: str | Path | None = None,
    views: Views | str | Path | None = None,
    resolution: tuple[int, int] | str | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    progress: bool | Progress = False,
) -> Gaussians:
    """Remove floaters from a scene, and what cannot be drawn or is seen from nowhere. No photos are
    needed.

    Findings (counts, clusters, PSNR without what goes) are logged at level INFO.

    Args:
        scene: N Gaussians, or the path of a PLY, a checkpoint, or a Splatfacto run.
        strength: in [0, 1]; more removes more floaters: Gaussians far before what views show,
            without which pictures hardly change. 0 removes none.
        picture: a PNG file to write: the scene, what goes in a colour for each cluster, and the
            result.
        views, resolution, up, data, progress: as for :func:`pointsplat_ns.prune`.

    Returns:
        The other Gaussians, bit for bit and in order, at least one, on the device of the given
        scene.

    Raises:
        SceneError: if no Gaussian can be drawn, or a file is not usable.
        PointSplatError: if the strength is not in [0, 1].

    Example:
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()[::10]
        >>> len(ps.clean(room)) <= len(room)
        True
    """
    return clean_source(scene, strength, Looking(views, resolution, up, data), picture, progress)[1]


@normal_mode
def clean_source(
    scene: Source,
    strength: float,
    looking: Looking,
    picture: str | Path | None = None,
    progress: bool | Progress = False,
) -> tuple[Gaussians, Gaussians, float, ViewSource]:
    """Read a scene and clean it, as :func:`clean`; results are those of :func:`prune_source`."""
    from pointsplat_ns.pipeline.cleaning import clean_scene
    from pointsplat_ns.tools.comparison_plots import plot_cleaning

    if not 0 <= strength <= 1:
        raise PointSplatError(f"strength {strength!r}: expected a number in [0, 1]")
    dense, source = read_source(scene, looking)
    need_usable(dense)
    start = time.perf_counter()
    with progress_bar(progress) as report:
        cleaning = clean_scene(dense, 1, source, report, strength)
        cleaned = cleaning.apply(dense, 1)
        seconds = time.perf_counter() - start
        if picture is not None:
            gone = dense[cleaning.junk.first(len(dense) - 1).indices.to(dense.device)]
            plot_cleaning(dense, gone, cleaned, source.scored(VIEW_COUNTS.scored), picture)
    log(cleaning.notes)
    return dense, cleaned, seconds, source


@normal_mode
def compact_source(
    scene: Source,
    request: CompactRequest,
    looking: Looking,
    progress: bool | Progress = False,
) -> tuple[Gaussians, Compacted, ViewSource]:
    """Read a scene and compact it; verdicts and notes are logged as details.

    Returns:
        The dense scene, the result, and the source of its views, to judge it in.
    """
    from pointsplat_ns.pipeline.compact import compact_scene, compact_to_psnr

    dense, source, photos = _read_photographed(scene, looking, progress)
    with progress_bar(progress) as report:
        if request.searched:
            result = compact_to_psnr(dense, request, source, report, *photos)
        else:
            result = compact_scene(dense, request, source, report, photos.training)
    _log_details((*result.notes, *result.verdict.splitlines()), source)
    log(tuple(filter(None, [result.target])))
    trained = next(
        (place for place, stage in enumerate(result.stages) if stage.photos is not None), None
    )
    _log_held_out(dense, (last_kept(result.stages[:trained]).scene, result.scene), photos)
    return dense, result, source


def read_source(scene: Source, looking: Looking) -> tuple[Gaussians, ViewSource]:
    """Read the dense scene, and make its source of views. Raises SceneError if a file is missing or
    damaged, or the scene is a ``pointsplat`` run, which is pruned already; and DataError if a file
    of cameras is not usable, or most of them see nothing of the scene."""
    from pointsplat_ns.nerfstudio_plugin.dataset_views import need_named_data, view_source

    views = looking.views
    data = looking.data
    if data is not None:
        need_named_data(scene if views is None or without_poses(views) else views, data)
    poses: Path | str | None = None if views is None else NO_POSES
    if isinstance(views, (str, Path)) and not without_poses(views):
        from pointsplat_ns.scene.camera_files import is_camera_file

        if not Path(views).exists():
            raise SceneError(
                f"{views}: no such file or folder; expected views, a run whose dataset has the "
                "poses, or a file of cameras"
            )
        poses = views if is_camera_file(views) else NO_POSES
    dense, found, _ = read_found(scene, poses)
    given = views if isinstance(views, Views) else found
    return dense, view_source(
        dense, given, looking.run_of(scene), data, looking.size, looking.upward
    )


class _Photos(NamedTuple):
    """Photos that are trained on and judge."""

    training: Photos | None = None
    held_out: Photos = ()


def _read_photographed(
    scene: Source, looking: Looking, progress: bool | Progress, training: bool = True
) -> tuple[Gaussians, ViewSource, _Photos]:
    """The dense scene, its views and its photos; those to train on only with ``training``. Errors
    are those of :func:`read_source`, and of
    :func:`~pointsplat_ns.pipeline.photos.posed_photos.read_with_photos`; or a SceneError if the photos of a
    run are wanted and there is no run, a DataError if its data is not found or unlike the scene."""
    if looking.photos is False:
        return *read_source(scene, looking), _Photos()
    if not isinstance(looking.photos, bool):
        from pointsplat_ns.pipeline.photos.posed_photos import read_with_photos

        with progress_bar(progress) as report:
            dense, posed = read_with_photos(
                scene,
                Path(looking.photos),
                looking.views,
                looking.data,
                looking.size,
                report,
                training,
            )
        source = ViewSource(dense, posed.views, resolution=looking.size, up=looking.upward)
        return dense, source, _Photos(posed.training, posed.held_out)
    if isinstance(scene, Gaussians):
        raise SceneError(
            "photos are read from the dataset of a run; expected the path of a run, or the folder "
            "of the photos"
        )
    from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos

    dense, source = read_source(scene, looking)
    photos = run_photos(scene, "train", looking.data)
    check_photos(dense, photos, str(scene))
    try:
        held_out = run_photos(scene, "test", looking.data)
        shown = spread_indices(len(held_out), VIEW_COUNTS.compared)
        return dense, source, _Photos(photos, [held_out[index] for index in shown])
    except DataError as error:
        log((f"there are no held-out photos: {error}",))
        return dense, source, _Photos(photos)


def _log_held_out(dense: Gaussians, results: tuple[Gaussians, ...], photos: _Photos) -> None:
    """Log the PSNR of results in held-out photos, if there are any."""
    if photos.held_out:
        from pointsplat_ns.pipeline.photos.posed_photos import held_out_text

        log((held_out_text(dense.to(default_device()), results, photos.held_out),))


def log(lines: tuple[str, ...]) -> None:
    """Log lines of text at level INFO."""
    for line in lines:
        logger.info("%s", line)


def _log_details(lines: tuple[str, ...], source: ViewSource) -> None:
    """Log lines of text at level DEBUG, but at level INFO that the poses of a run are not found."""
    for line in lines:
        logger.log(
            logging.INFO if source.missing and line == source.text else logging.DEBUG, "%s", line
        )
