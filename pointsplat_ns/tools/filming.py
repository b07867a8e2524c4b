"""Public functions to view scenes: films along camera paths, and a viewer in the browser."""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from pointsplat_ns.errors import SceneError
from pointsplat_ns.pipeline.options import NO_POSES, ViewOptions
from pointsplat_ns.pipeline.subject import Source, read_subject
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.scene.formats.sog_stream import coarser_levels
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import RUN_FILES, may_be_run, open_run, scene_name
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.outputs import outputs_claimed
from pointsplat_ns.system.progress import Progress, tracked
from pointsplat_ns.tools.loading import load
from pointsplat_ns.tools.pages.film import PHOTO_SIDE, FilmSettings, camera_path, render_frames
from pointsplat_ns.tools.pages.video import check_output, write_frames
from pointsplat_ns.view_sampling.upright import up_named

if TYPE_CHECKING:
    from pointsplat_ns.tools.pages.viewer import Viewer

logger = logging.getLogger("pointsplat_ns")


@outputs_claimed()
def render_path(
    scene: Source,
    output: str | Path,
    other: Source | None = None,
    *,
    views: Views | str | Path | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    width: int | None = None,
    height: int | None = None,
    fps: float = 24.0,
    seconds: float | None = None,
    force: bool = False,
    progress: bool | Progress = False,
) -> int:
    """Film a scene, or two scenes side by side from the same cameras.

    The camera path passes exactly through the views, or through the poses of the run's dataset.
    Without known views, it circles an object, or walks past the views that show most of a room.

    Args:
        scene: N Gaussians, or the path of a scene.
        output: ``.mp4`` for a video (H.264), a folder for PNG frames, ``.png`` for only the first
            frame. It appears only when complete.
        other: a second scene in the same frame, to compare with. Both are labelled with their names
            and counts.
        views: views along the path, in place of the dataset's poses: views, or a camera file
            (``cameras.json`` of 3DGS, ``transforms.json`` of nerfstudio, the folder of a COLMAP
            model).
        up: up axis of the scene ("z", "-y") for a film without views; by default declared by the
            scene, or estimated.
        data: folder of the run's photos and poses, or a folder above it, if the data has moved.
        width: width of one scene's picture, pixels; by default that of the photos, at most 960.
        height: height of one scene's picture, pixels.
        fps: frames per second.
        seconds: length of the film; by default 10, or enough for every pose of a dataset. A folder
            of frames has one frame per view of ``views`` by default.
        force: overwrite existing files.
        progress: True shows a bar with the time left; a function is called with the share done.

    Returns:
        The number of frames written.

    Raises:
        SceneError: if a scene is not usable, or the output cannot be written.
        DataError: if nothing of the scene is visible, or most views of a camera file see nothing of
            it.
        PointSplatError: if a size, speed or length is invalid.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()[::20]
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.render_path(room, f"{folder}/walk.mp4", width=64, height=48, fps=10, seconds=0.5)
        5
    """
    settings = FilmSettings(width, height, fps, seconds)
    given = views if isinstance(views, Views) else None
    options = ViewOptions(poses=None if isinstance(views, Views) else views, up=up, data=data)
    options.check()
    kind = check_output(output, force)
    subject = read_subject(scene, options, given)
    dense = subject.dense
    source = subject.views()
    if source.given is not None and given is None:  # from a camera file, at the size of its photos
        source = ViewProvider(dense, source.given.resized(PHOTO_SIDE))
    sources = [scene]
    loaded = [dense]
    if other is not None:
        sources.append(other)
        loaded.append(_loaded(other).at_offset(dense.offset))
    if source.given is not None and kind == "frames" and seconds is None:
        settings = replace(settings, seconds=len(source.given) / fps)
    cameras, origin = camera_path(dense, source, settings, kind == "picture", options.upward)
    names = [
        f"{_name(shown, index)}, {len(gaussians):,} Gaussians"
        for index, (shown, gaussians) in enumerate(zip(sources, loaded, strict=True))
    ]
    logger.info("%d x %d pixels: %s", cameras.width, cameras.height, origin)
    frames = render_frames(loaded, cameras, names if len(loaded) > 1 else ())
    return write_frames(
        tracked(frames, "rendering", len(cameras), progress), Path(output), kind, fps, force
    )


def open_viewer(
    scene: Source | None = None,
    other: Source | None = None,
    *,
    views: Views | str | Path | None = None,
    up: str | None = None,
    data: str | Path | None = None,
    host: str = "127.0.0.1",
    port: int = 7007,
) -> Viewer:
    """Show a scene, or two scenes with the same camera, in a browser, which renders with WebGL 2.

    The page opens upright, at the known or sampled view that shows most of the scene, or at a view
    of a whole object. It says if the file of a scene changes or disappears meanwhile.

    Args:
        scene: N Gaussians, or the path of a scene; by default the page opens a dropped file.
        other: a second scene in the same frame, to compare with; by default all Gaussians of the
            first.
        views: known views of the first scene, as for :func:`render_path`.
        up: up axis of the scene ("z", "-y"); by default declared by the scene, or estimated.
        data: folder of the data of ``scene``, as for :func:`render_path`.
        host: address to listen on; by default only this machine has access. With another address,
            every machine in reach has access.
        port: first port to try; 0 takes any free port.

    Returns:
        The viewer, to close after use, or to use in a ``with`` block; ``url`` is its address.

    Raises:
        SceneError: if a scene is not usable.
        DataError: if no Gaussian of the first scene is visible.
        PointSplatError: if no port is free.

    Example:
        >>> import pointsplat_ns as ps
        >>> with ps.open_viewer(ps.example_room()[::20], port=0) as viewer:
        ...     viewer.url.startswith("http://127.0.0.1:")
        True
    """
    from pointsplat_ns.tools.pages.slider_scenes import ViewedScene
    from pointsplat_ns.tools.pages.viewer import Viewer
    from pointsplat_ns.tools.watched_file import WatchedFile

    upward = up_named(up)

    def read(path: Path, name: str) -> ViewedScene:
        subject = read_subject(path, ViewOptions(poses=NO_POSES))
        return ViewedScene(name, None, subject.dense, subject.views())

    scenes: list[ViewedScene] = []
    for index, shown in enumerate(item for item in (scene, other) if item is not None):
        path = None if isinstance(shown, Gaussians) else Path(shown)
        file = None if path is None else WatchedFile(path)
        if scenes:
            loaded = _loaded(shown).at_offset(scenes[0].scene.offset)
            source = ViewProvider(loaded, run=path)
        else:  # ``upward`` is for the page, not for merging
            given = views if isinstance(views, Views) else None
            named = None if isinstance(views, Views) else views
            subject = read_subject(shown, ViewOptions(poses=named, data=data), given)
            loaded = subject.dense
            source = subject.views()
        levels = (
            []
            if path is None or (path / RUN_FILES.config).is_file()
            else coarser_levels(path, len(loaded))
        )
        scenes.append(ViewedScene(_name(shown, index), path, loaded, source, levels, file))
    return Viewer(scenes, host, port, upward, None if scenes else read)


def _loaded(scene: Source) -> Gaussians:
    return scene if isinstance(scene, Gaussians) else load(scene)


def _name(scene: Source, index: int) -> str:
    """The name of a scene: its run's experiment, or its file."""
    if isinstance(scene, Gaussians):
        return ("first", "second")[index]
    if may_be_run(scene):
        with suppress(SceneError):
            return scene_name(open_run(scene, need_data=False))
    return Path(scene).resolve().name
