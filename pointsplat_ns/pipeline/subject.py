"""Reads the subject of a request: the dense scene, its views and its photos."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from pointsplat_ns.errors import DataError, SceneError
from pointsplat_ns.pipeline.options import NO_POSES, ViewOptions
from pointsplat_ns.pipeline.photos.examples import Photos
from pointsplat_ns.pipeline.photos.posed_photos import read_with_photos
from pointsplat_ns.pipeline.photos.posed_scene import check_photos, read_scene_and_cameras
from pointsplat_ns.pipeline.run_data import run_data
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS, ViewProvider
from pointsplat_ns.scene.camera_files import is_camera_file
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views, spread_indices
from pointsplat_ns.system.progress import Progress, silent

Source = Gaussians | str | Path
"""A dense scene, or its path."""


@dataclass(frozen=True, eq=False)
class Subject:
    """The dense scene of a request, with its views and photos."""

    dense: Gaussians
    options: ViewOptions
    given: Views | None = None
    """Known views; None if views come from the dataset of ``run``, or are sampled."""
    run: Path | str | None = None
    """File or folder of the run whose dataset may have the poses."""
    poses: Path | None = None
    """The camera file of the views."""
    training: Photos | None = None
    """Photos to train on; None if not requested."""
    held_out: Photos = ()
    """Photos to judge by."""
    no_held_out: str = ""
    """Error for which there are no held-out photos."""

    def views(self) -> ViewProvider:
        """A new provider of the views."""
        return ViewProvider(
            self.dense,
            given=self.given,
            run=self.run,
            data=self.options.data,
            resolution=self.options.size,
            up=self.options.upward,
        )


def read_subject(
    scene: Source,
    options: ViewOptions,
    views: Views | None = None,
    photos: Path | str | bool = False,
    training: bool = True,
    progress: Progress = silent,
) -> Subject:
    """Read the dense scene, its views and, on request, its photos.

    Args:
        scene: N Gaussians, or the path of a scene.
        options: options on views.
        views: known views, in place of ``options.poses``.
        photos: whether to read the photos of the scene's run; or a folder of photos. Its poses come
            from ``options.poses``, or from a camera file nearby.
        training: whether to read the photos that are not held out.
        progress: called with the name of the current task and the share of it that is done, in [0,
            1].

    Raises:
        SceneError: if a file is missing or damaged, the scene is a ``pointsplat`` run, which is
            already pruned, or photos of a run are requested and there is no run.
        DataError: if a camera file is not usable, most of its cameras see nothing of the scene, or
            photos are missing or do not match the scene.
    """
    if not isinstance(photos, bool):
        named = options.poses if views is None else views
        dense, posed = read_with_photos(
            scene, Path(photos), named, options.data, options.size, progress, training
        )
        return Subject(
            dense,
            options,
            given=posed.views,
            poses=posed.poses,
            training=posed.training,
            held_out=posed.held_out,
        )
    if photos and isinstance(scene, Gaussians):
        raise SceneError(
            "photos are read from the dataset of a run; expected the path of a run, or the folder "
            "of the photos"
        )
    subject = _read_with_views(scene, options, views)
    if not photos:
        return subject
    assert not isinstance(scene, Gaussians)
    trained = run_data().photos(scene, "train", options.data)
    check_photos(subject.dense, trained, str(scene))
    held_out: Photos = ()
    missing = ""
    try:
        every = run_data().photos(scene, "test", options.data)
        held_out = [every[index] for index in spread_indices(len(every), VIEW_COUNTS.compared)]
    except DataError as error:
        missing = str(error)
    return replace(subject, training=trained, held_out=held_out, no_held_out=missing)


def _read_with_views(scene: Source, options: ViewOptions, views: Views | None) -> Subject:
    """The dense scene and its views: given, from a camera file, or from a run."""
    named = views if options.poses is None else options.poses
    if options.data is not None:
        run_data().check_named(scene if named is None or options.sampled else named, options.data)
    file = _camera_file(options)
    looked_for = None if named is None else NO_POSES
    dense, found, place = read_scene_and_cameras(scene, looked_for if file is None else file)
    run: Path | str | None = None
    if named is None and not isinstance(scene, Gaussians):
        run = scene
    elif options.poses is not None and not options.sampled:
        run = options.poses
    return Subject(dense, options, given=found if views is None else views, run=run, poses=place)


def _camera_file(options: ViewOptions) -> Path | str | None:
    """The camera file in ``poses``; None if ``poses`` is a run or not a path. Raises SceneError if
    the path does not exist."""
    if options.poses is None or options.sampled:
        return None
    if not Path(options.poses).exists():
        raise SceneError(
            f"{options.poses}: no such file or folder; expected a camera file, or a run whose "
            "dataset has the poses"
        )
    return options.poses if is_camera_file(Path(options.poses)) else None
