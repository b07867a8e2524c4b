"""The page beside a streamed SOG, in which PlayCanvas' SuperSplat viewer shows it.

The viewer turns a scene by half a turn about z, so that -y is up. A stream with a page is turned until its up
direction is -y; every viewer of such files then shows it upright.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import smallest_turn
from pointsplat_ns.io.files import open_inside
from pointsplat_ns.io.formats import STREAM_META
from pointsplat_ns.io.turning import Similarity
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.upright import Up
from pointsplat_ns.pages.flight import FlightFrame, eyes_of
from pointsplat_ns.pages.web_viewer import WebViewer, WebViewerPackage, known_digests
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.views import Views


@dataclass(frozen=True, eq=False)
class StreamPage:
    """The page of a stream."""

    turn: Similarity | None
    """Turns the stream's Gaussians until -y is up; None if it is already."""
    files: Mapping[str, bytes]
    """The files of the page, by name."""
    note: str
    """Text on the up direction."""


def stream_page(viewer: WebViewer, scene: Gaussians, known: Views | None, up: Up | None, title: str) -> StreamPage:
    """The page of a scene's stream. It opens upright, with the view that shows most.

    Args:
        viewer: its files.
        scene: N Gaussians, not turned.
        known: views that people took, if there are any; see :meth:`~pointsplat_ns.pages.flight.FlightFrame.of`.
        up: which way is up; by default the scene's own, that of the views, or estimated.
        title: of the page.

    Raises:
        SceneError: if no Gaussian can be drawn.
        DataError: if none is visible.
        PointSplatError: if the viewer's page is another than expected.
    """
    frame = FlightFrame.of(scene, known, up)
    wanted = torch.tensor([0.0, -1.0, 0.0], **DOUBLES)
    matrix = smallest_turn(frame.up.direction.double(), wanted)
    turned = float((frame.up.direction - wanted).abs().max()) > 1e-6
    turn = Similarity(matrix, 1.0, torch.zeros(3, **DOUBLES)) if turned else None
    bootstrap = {"generator": "pointsplat-ns", "contentUrl": f"./{STREAM_META}", "settings": _settings(frame, turn)}
    named = str(frame.up).replace("(a guess)", "(a guess; --up names another axis)")
    note = f"the page: up is {named}" + (", turned to -y as viewers show it" if turned else "")
    return StreamPage(turn, viewer.page(title, bootstrap), note)


def page_files(folder: Path) -> list[Path]:
    """The files of the page that was written to a folder, ``index.html`` first; none if there is no page of ours."""
    files = [folder / name for name in WebViewerPackage().members.values()]
    try:
        with files[0].open("rb") as stream:
            ours = b'id="sse-bootstrap">{"generator":"pointsplat-ns"' in stream.read(1 << 16)
    except OSError:
        return []
    return [file for file in files if file.is_file()] if ours else []


_WORDS = {"pointsplat-ns", f"./{STREAM_META}", "still", "none", "step", "animTrack"}
"""All texts among the values that a page of ours starts with."""


def own_page(folder: Path) -> dict[str, bytes]:
    """The files of the page in a folder, ``index.html`` first, if they are those that :func:`stream_page` makes of the
    known viewer, or of the one that the environment names; else none. A stranger's folder may hold any script under
    these names."""
    package, files = WebViewerPackage(), {}
    try:
        for name in package.members.values():
            with open_inside(folder, folder / name) as stream:
                files[name] = stream.read(package.largest)
        page = WebViewer(files)
        ours = page.digests() == known_digests() and _is_plain(page.bootstrap())
    except (OSError, ValueError, RecursionError, PointSplatError):
        return {}
    return files if ours else {}


def _is_plain(value: Any) -> bool:
    """Whether values that a page starts with are such as :func:`stream_page` gives it: numbers, and known words."""
    if isinstance(value, dict):
        return all(map(_is_plain, value.values()))
    if isinstance(value, list):
        return all(map(_is_plain, value))
    return value is None or isinstance(value, (bool, int, float)) or value in _WORDS


def _settings(frame: FlightFrame, turn: Similarity | None) -> dict[str, Any]:
    """The viewer's settings, of version 2, for the first view of a frame. Its world is the file turned by half a turn
    about z; its angle of view is that of the picture's longer side, degrees."""
    views = frame.views
    eye = eyes_of(views)[0] * (frame.size / UNITS) + frame.centre
    ahead = views.viewmats[0, 2, :3]
    # What the camera turns about: beside the middle of the content, or not too near.
    distance = max(float(ahead @ (frame.centre - eye)), 0.25 * frame.size)
    angle = 2 * math.degrees(math.atan(0.5 * max(views.width, views.height) / float(views.Ks[0, 0, 0].abs())))
    points = torch.stack([eye, eye + distance * ahead])
    if turn is not None:
        points = points @ turn.matrix.T
    position, target = (points * points.new_tensor([-1.0, -1.0, 1.0])).tolist()
    still = {  # else the viewer flies its own path, of the same size in every scene
        "name": "still",
        "duration": 1,
        "frameRate": 1,
        "loopMode": "none",
        "interpolation": "step",
        "smoothness": 0,
        "keyframes": {
            "times": [0, 1],
            "values": {"position": 2 * position, "target": 2 * target, "fov": 2 * [angle]},
        },
    }
    off = {"enabled": False}
    return {
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": views.background.tolist()},
        "postEffectSettings": {
            "sharpness": {**off, "amount": 0},
            "bloom": {**off, "intensity": 0.1, "blurLevel": 2},
            "grading": {**off, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {**off, "intensity": 0.5, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {**off, "intensity": 0.5},
        },
        "animTracks": [still],
        "cameras": [{"initial": {"position": position, "target": target, "fov": angle}}],
        "annotations": [],
        "startMode": "animTrack",
    }
