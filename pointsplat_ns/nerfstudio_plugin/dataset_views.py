"""The poses and photos of a run's dataset."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.errors import DataError, MissingPackageError, SceneError, need
from pointsplat_ns.nerfstudio_plugin.registration import import_nerfstudio
from pointsplat_ns.pipeline.photos.examples import Photos
from pointsplat_ns.pipeline.photos.posed_scene import check_photos
from pointsplat_ns.pipeline.view_provider import ViewSource
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import may_be_run, open_run, scene_name
from pointsplat_ns.scene.views import Views
from pointsplat_ns.view_sampling.upright import Up

if TYPE_CHECKING:
    from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import Split
    from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene


def dataset_views(
    path: Path | str, split: Split = "train", data: Path | str | None = None
) -> Views:
    """The poses of a Splatfacto run's dataset, in the frame and at the resolution that it was
    trained in; those of training photos as the training corrected them.

    Needs nerfstudio, which takes a few seconds to import.

    Args:
        path: the run's folder, ``config.yml`` or checkpoint.
        split: "train" for the poses of the training photos, "test" for those of the held-out
            photos.
        data: where the run's data is now, if it moved: the data itself, or a folder above it.

    Returns:
        C views on the CPU, with the background colour that the run is evaluated with.

    Raises:
        SceneError: if ``path`` is not a run, or the run's data is missing.
        DataError: if the poses are not usable, the split has none, or nerfstudio is not installed.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.dataset_views("outputs/no_run")
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.SceneError: outputs/no_run: no such file or folder; expected a
        nerfstudio run
    """
    return _scene_at(path, data).views(split)


def view_source(
    scene: Gaussians,
    given: Views | None = None,
    run: Path | str | None = None,
    data: Path | str | None = None,
    resolution: tuple[int, int] | None = None,
    up: Up | None = None,
) -> ViewSource:
    """The source of a scene's views: given ones, those of a run's dataset, else sampled ones;
    arguments as of :class:`~pointsplat_ns.pipeline.view_provider.ViewSource` and :func:`dataset_views`."""
    return ViewSource(
        scene, given, run, functools.partial(dataset_views, data=data), resolution, up
    )


def run_photos(path: Path | str, split: Split = "train", data: Path | str | None = None) -> Photos:
    """The photos of a split of a run's dataset, read when they are asked for. Arguments and errors
    are those of :func:`dataset_views`; a photo that cannot be used is a DataError when it is asked
    for."""
    scene = _scene_at(path, data)
    if split == "train":
        scene.need_photos_as_rendered("leave the photos out")
    return scene.photos(split)


def need_named_data(scene: object, data: Path | str | None) -> None:
    """If the data of a run is named, check that it serves: a PointSplatError if ``scene`` is no
    path of a run, the poses cannot be read there, or photos are not like renders. Where nothing is
    named, data that is missing is no error."""
    if data is None:
        return
    if not isinstance(scene, (str, Path)) or not may_be_run(scene):
        what = scene if isinstance(scene, (str, Path)) else "a scene in memory"
        raise SceneError(
            f"{what}: no run, so it has no data at {data}; expected a run, or no --data"
        )
    trained = _scene_at(scene, data)
    check_photos(trained.read_dense(), trained.photos("train"), data)


def _scene_at(path: Path | str, data: Path | str | None) -> TrainedScene:
    """The scene of a run. Its photos stay in memory as far as there is room."""
    run = open_run(path, data=data)  # before nerfstudio is imported, which takes seconds
    try:
        need("nerfstudio", "reading the photos and poses of a run")
    except MissingPackageError as error:
        raise DataError(str(error)) from error
    import_nerfstudio()

    from pointsplat_ns.nerfstudio_plugin.frames import MemoryCache
    from pointsplat_ns.nerfstudio_plugin.pointsplat.scenes import TrainedScene

    return TrainedScene(scene_name(run), run, MemoryCache.of())
