"""The page beside a streamed SOG, in which PlayCanvas' SuperSplat viewer shows it.

The viewer turns a scene by half a turn about z, so that -y is up. A stream with a page is turned until its up
direction is -y; every viewer of such files then shows it upright.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import smallest_turn
from pointsplat_ns.io.formats import STREAM_META
from pointsplat_ns.io.turning import Similarity
from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.upright import Up
from pointsplat_ns.pages.flight import FlightFrame, eyes_of
from pointsplat_ns.pages.web_viewer import filled
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


def stream_page(
    viewer: Mapping[str, bytes], scene: Gaussians, known: Views | None, up: Up | None, title: str
) -> StreamPage:
    """The page of a scene's stream. It opens upright, with the view that shows most.

    Args:
        viewer: its files, see :func:`~pointsplat_ns.pages.web_viewer.web_viewer`.
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
    return StreamPage(turn, filled(viewer, title, bootstrap), note)


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
