"""Scenes of a sweep, kept for its page to fly through."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import write_json
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.pruning import ply_bytes

MAX_BYTES = 4_000_000
"""Largest size of a page's scenes; the rest of the page is for its pictures."""

_RATIO = 20
"""A PLY of more than so many times that size is not tried: in a page, scenes have a tenth of its bytes or more."""

_KEYS = {"scenes", "views", "up", "near", "background", "antialiased", "drag"}


def keep_flight(stage: FlightFrame, scene: Gaussians, name: str, path: Path) -> bool:
    """Write a scene for the page, if it is small enough for that.

    Args:
        stage: where it is looked at from.
        scene: N Gaussians.
        name: of the scene, for people.
        path: the file, at :func:`~pointsplat_ns.tradeoff.points.flight_path`.

    Returns:
        Whether it was written.

    Raises:
        SceneError: if it cannot be written.
    """
    if ply_bytes(len(scene), scene.sh_degree) > _RATIO * MAX_BYTES:
        return False
    packed = stage.packed(scene, name)
    if len(packed["spz"]) > 0.99 * MAX_BYTES:  # the views take some as well
        return False
    write_json(stage.data([packed]), path)
    return True


def read_flight_beside(path: Path, dense: Path) -> dict[str, Any] | None:
    """A scene that :func:`keep_flight` wrote, with the dense scene on the left if both fit; None if it was too large,
    or the file holds something else.

    Args:
        path: of the scene.
        dense: of the dense scene, which may be the same.
    """
    flight = _read(path)
    beside = _read(dense) if dense != path else None
    if flight is None or beside is None:
        return flight
    scenes = [*beside["scenes"], *flight["scenes"]]
    return {**flight, "scenes": scenes} if sum(len(scene["spz"]) for scene in scenes) <= MAX_BYTES else flight


def _read(path: Path) -> dict[str, Any] | None:
    try:
        if path.stat().st_size > MAX_BYTES:
            return None
        flight = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    scenes = flight["scenes"] if isinstance(flight, dict) and flight.keys() == _KEYS else None
    known = (
        isinstance(scenes, list) and scenes and all(isinstance(s, dict) and type(s.get("spz")) is str for s in scenes)
    )
    return flight if known else None
