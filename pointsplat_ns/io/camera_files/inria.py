"""``cameras.json``, which INRIA's training of 3D Gaussian Splatting writes beside its scenes.

It is a list of cameras with ``id``, ``img_name``, ``width``, ``height``, ``position`` (3), ``rotation`` (3 x 3, camera
to world, OpenCV axes), ``fx`` and ``fy``. The principal point is the picture's centre. Poses are in the scene's frame.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.camera_files.cameras import Camera, CameraFile, finite, matrix, need_count


def inria_cameras(content: list[Any], path: Path) -> CameraFile:
    """The cameras in the JSON of a ``cameras.json``; a DataError if an entry is no camera."""
    need_count(path, len(content))
    return CameraFile([_camera(entry, index, path) for index, entry in enumerate(content)])


def _camera(entry: Any, index: int, path: Path) -> Camera:
    entry = entry if isinstance(entry, dict) else {}
    rotation, position = matrix(entry.get("rotation"), (3,), 3), matrix([entry.get("position")], (1,), 3)
    if rotation is None or position is None:
        raise DataError(
            f"{path}: camera {index} has no pose; expected 'rotation', 3 x 3 numbers, and 'position', 3 numbers, as "
            "3DGS training writes them"
        )
    width, height, fx, fy = (finite(entry.get(name)) for name in ("width", "height", "fx", "fy"))
    if width is None or height is None or fx is None or fy is None:
        raise DataError(f"{path}: camera {index} has no intrinsics; expected numbers 'width', 'height', 'fx' and 'fy'")
    rows = [[*row, place] for row, place in zip(rotation, position[0], strict=True)]
    name = entry.get("img_name")
    return Camera(
        name if isinstance(name, str) else "",
        [*sum(rows, []), 0.0, 0.0, 0.0, 1.0],
        (width, height),
        (fx, fy),
        (0.5 * width, 0.5 * height),
    )
