"""Writes an HTML file to fly through a scene, or to compare two."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.pruning import need_usable
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.files import logger, replacing
from pointsplat_ns.system.progress import Progress, progress_bar
from pointsplat_ns.tools.pages.flight import FLIGHT_SCRIPTS, FlightFrame
from pointsplat_ns.tools.pages.html import page
from pointsplat_ns.view_sampling.upright import up_named


def write_page(
    scenes: Gaussians | Sequence[Gaussians],
    path: str | Path,
    names: Sequence[str] | None = None,
    *,
    title: str | None = None,
    notes: Sequence[str] = (),
    views: Views | None = None,
    up: str | None = None,
    limit_mb: float = 60.0,
    progress: bool | Progress = False,
) -> Path:
    """Write one HTML file to fly through a scene offline, or through two with a wipe between them.

    The file is self-contained. A browser with WebGL 2 draws scenes by the same formulas as
    :func:`~pointsplat_ns.render`. Scenes are stored as SPZ in text, a tenth to a quarter of the
    bytes of a PLY; docs/formats.md gives the loss. If two scenes make the file too large, the
    larger one is left out, with a warning and a note in the page.

    Args:
        scenes: one scene, or two: the first is on the left of the wipe.
        path: file to write.
        names: names of the scenes; by default the title, or "left" and "right".
        title: title of the page; by default the name of the file.
        notes: lines of text for the reader.
        views: known views for the page's buttons; by default sampled for the first scene. The page
            opens at the view that shows most, or that shows a whole object. Background and
            rasterize mode of the views apply to all scenes.
        up: up axis of the scene ("z", "-y"); by default declared by the scene, from the views, or
            estimated.
        limit_mb: maximum size of the file, in units of 10^6 bytes.
        progress: True shows a bar; a function is called with the name of the task and its share
            done.

    Returns:
        ``path``.

    Raises:
        PointSplatError: if there are no scenes or more than two, the number of names differs, or
            one scene alone is too large.
        SceneError: if no Gaussian of a scene can be drawn, or the file cannot be written.
        DataError: if no Gaussian of the first scene is visible.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> room = ps.example_room()[::20]
        >>> small = ps.prune(room, keep="30%", by="coverage")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     page = ps.write_page([room, small], f"{folder}/room.html", ["all", "three tenths"])
        ...     page.stat().st_size < 300_000
        True
    """
    path = Path(path)
    scenes = [scenes] if isinstance(scenes, Gaussians) else list(scenes)
    title = path.stem if title is None else title
    names = ([title] if len(scenes) == 1 else ["left", "right"]) if names is None else list(names)
    if not 1 <= len(scenes) <= 2:
        raise PointSplatError(f"{len(scenes)} scenes for {path}; expected one or two")
    if len(names) != len(scenes):
        raise PointSplatError(f"{len(names)} names for {len(scenes)} scenes; expected one for each")
    if not limit_mb > 0:
        raise PointSplatError(f"a page of at most {limit_mb:g} MB; expected a number above 0")
    upward = up_named(up)
    scenes = [scene.at_offset(scenes[0].offset) for scene in scenes]
    for scene in scenes:
        need_usable(scene)
    with progress_bar(progress) as report:
        report("looking for views", 0.0)
        frame = FlightFrame.of(scenes[0], views, upward)

        def packed(name: str, scene: Gaussians) -> dict[str, str]:
            return frame.packed(scene, name, lambda _, share: report(f"compressing {name}", share))

        included = [packed(name, scene) for name, scene in zip(names, scenes, strict=True)]
        missing = ""
        while True:
            html = page(
                "scene.html",
                (*FLIGHT_SCRIPTS, "scene.js"),
                ("worker-src blob:",),
                title=title,
                notes=notes,
                missing=missing,
                flight=frame.data(included),
                live=False,
                drops=(),
            )
            if len(html) <= 1e6 * limit_mb:
                break
            excess = (
                f"the page would have {len(html) / 1e6:.1f} MB, more than the {limit_mb:g} MB "
                "allowed"
            )
            if len(included) == 1:
                raise PointSplatError(
                    f"{path}: {excess}; expected a larger limit, or fewer Gaussians"
                )
            largest = max(included, key=lambda scene: len(scene["spz"]))
            included.remove(largest)
            missing = f"{largest['name']} is left out: with it {excess}"
            logger.warning("%s: %s", path, missing)
    with replacing(path) as part:
        part.write_bytes(html)
    return path
