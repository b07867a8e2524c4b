"""Files with the scenes of a sweep, for flights in its page."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import read_text, write_json
from pointsplat_ns.pages.flight import FlightFrame
from pointsplat_ns.pruning import ply_bytes

MAX_BYTES = 4_000_000
"""Largest size of a page's scenes in bytes; the rest of the page is for its pictures."""


def keep_flight(frame: FlightFrame, scene: Gaussians, name: str, path: Path) -> bool:
    """Write a scene for the page to a file at :func:`~pointsplat_ns.tradeoff.points.flight_path`, under a name, if it
    is small enough. Returns whether it was written."""
    if ply_bytes(len(scene), scene.sh_degree) > 20 * MAX_BYTES:  # SPZ in a page has at least a tenth of the bytes
        return False
    packed = frame.packed(scene, name)
    if len(packed["spz"]) > 0.99 * MAX_BYTES:  # the rest is for the views
        return False
    write_json(frame.data([packed]), path)
    return True


def read_flight_beside(path: Path, dense: Path) -> dict[str, Any] | None:
    """Read a scene of :func:`keep_flight`, with the dense scene, of another file, on the left if both fit; None if
    there is no such file, or it holds something else."""
    flight = _read(path)
    beside = _read(dense) if dense != path else None
    if flight is None or beside is None:
        return flight
    scenes = [*beside["scenes"], *flight["scenes"]]
    return {**flight, "scenes": scenes} if sum(len(scene["spz"]) for scene in scenes) <= MAX_BYTES else flight


def _read(path: Path) -> dict[str, Any] | None:
    try:
        flight = json.loads(read_text(path, MAX_BYTES))
    except (OSError, ValueError, RecursionError):
        return None
    keys = {"scenes", "views", "aspect", "up", "sure", "near", "background", "antialiased", "drag"}
    scenes = flight["scenes"] if isinstance(flight, dict) and flight.keys() == keys else None
    known = (
        isinstance(scenes, list) and scenes and all(isinstance(s, dict) and type(s.get("spz")) is str for s in scenes)
    )
    return flight if known else None
