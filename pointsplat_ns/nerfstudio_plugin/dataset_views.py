"""The poses and photos of a run's dataset, registered for the package by an entry point."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.errors import DataError, MissingPackageError, SceneError, need
from pointsplat_ns.nerfstudio_plugin.registration import import_nerfstudio
from pointsplat_ns.pipeline.photos.examples import Photos
from pointsplat_ns.pipeline.photos.posed_scene import check_photos
from pointsplat_ns.scene.runs import may_be_run, open_run, scene_name
from pointsplat_ns.scene.views import Views

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


def run_photos(path: Path | str, split: Split = "train", data: Path | str | None = None) -> Photos:
    """The photos of a run's dataset with their poses, in the frame and at the resolution that the
    run was trained in.

    A photo is read when it is asked for: ``view, target, mask = photos[0]`` gives its
    :class:`~pointsplat_ns.scene.views.View`, the photo (H, W, 3), in [0, 1] or uint8, and the
    pixels that count, (H, W, 1) bool or None for all. A photo that cannot be used raises a
    DataError then. Needs nerfstudio, which takes a few seconds to import.

    Args:
        path: the run's folder, ``config.yml`` or checkpoint.
        split: "train" for the training photos, "test" for the held-out photos.
        data: where the run's data is now, if it moved: the data itself, or a folder above it.

    Returns:
        A sequence of C photos with views on the CPU.

    Raises:
        SceneError: if ``path`` is not a run, or the run's data is missing.
        DataError: if the poses are not usable, the split has none, nerfstudio is not installed, or
            the training fitted colours to each of its photos, which renders do not have.

    Example:
        >>> import pointsplat_ns as ps
        >>> ps.run_photos("outputs/no_run")
        Traceback (most recent call last):
        ...
        pointsplat_ns.errors.SceneError: outputs/no_run: no such file or folder; expected a
        nerfstudio run
    """
    scene = _scene_at(path, data)
    if split == "train":
        scene.need_photos_as_rendered("leave the photos out")
    return scene.photos(split)


def check_named_data(run: object, data: Path | str) -> None:
    """Check that the data that was named for a run serves: a PointSplatError if ``run`` is no path
    of a run, the poses cannot be read there, or photos are not like renders."""
    if not isinstance(run, (str, Path)) or not may_be_run(run):
        what = run if isinstance(run, (str, Path)) else "a scene in memory"
        raise SceneError(
            f"{what}: no run, so it has no data at {data}; expected a run, or no --data"
        )
    trained = _scene_at(run, data)
    check_photos(trained.read_dense(), trained.photos("train"), data)


class NerfstudioData:
    """The datasets of nerfstudio's runs, for :mod:`pointsplat_ns.pipeline.run_data`."""

    def views(self, run: Path | str, split: Split, data: Path | str | None) -> Views:
        """As :func:`dataset_views`."""
        return dataset_views(run, split, data)

    def photos(self, run: Path | str, split: Split, data: Path | str | None) -> Photos:
        """As :func:`run_photos`."""
        return run_photos(run, split, data)

    def check_named(self, run: object, data: Path | str) -> None:
        """As :func:`check_named_data`."""
        check_named_data(run, data)


RUN_DATA = NerfstudioData()
"""The object of the entry point."""


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
