"""Scenes of a sweep, kept as its page shows them to fly through."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import write_json
from pointsplat_ns.pages.flight import Stage
from pointsplat_ns.pruning import ply_bytes

MAX_BYTES = 4_000_000
"""Of the page, at most, for scenes to fly through; the rest is for its pictures."""

_RATIO = 20
"""A PLY of so many times the bytes that there are is not tried: in a page, scenes have a tenth of its bytes or more."""

_KEYS = {"scenes", "views", "up", "near", "background", "antialiased", "drag"}


def keep_flight(stage: Stage, scene: Gaussians, name: str, path: Path) -> bool:
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


def read_flight(path: Path) -> dict[str, Any] | None:
    """What :func:`keep_flight` wrote; None if there is nothing like it, as of scenes that were too large."""
    try:
        if path.stat().st_size > MAX_BYTES:
            return None
        flight = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError, RecursionError):
        return None
    return flight if _is_flight(flight) else None


def _is_flight(content: Any) -> bool:
    scenes = content["scenes"] if isinstance(content, dict) and content.keys() == _KEYS else None
    if not isinstance(scenes, list) or not scenes:
        return False
    return all(isinstance(scene, dict) and isinstance(scene.get("spz"), str) for scene in scenes)


def read_flight_beside(path: Path, dense: Path) -> dict[str, Any] | None:
    """What :func:`keep_flight` wrote of a scene, with the dense scene on the left if both fit; None as for
    :func:`read_flight`.

    Args:
        path: of the scene.
        dense: of the dense scene, which may be the same.
    """
    flight = read_flight(path)
    beside = read_flight(dense) if dense != path else None
    if flight is None or beside is None:
        return flight
    scenes = [*beside["scenes"], *flight["scenes"]]
    return {**flight, "scenes": scenes} if sum(len(scene["spz"]) for scene in scenes) <= MAX_BYTES else flight
