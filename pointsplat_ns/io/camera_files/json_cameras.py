"""Cameras in JSON: nerfstudio's ``transforms.json``, the poses of ``ns-export cameras``, and INRIA's ``cameras.json``.

``transforms.json`` is that of nerfstudio, instant-ngp and NeRF-synthetic. ``frames`` have ``transform_matrix``, from
camera to world, OpenGL axes (x right, y up, z back). ``fl_x``, ``fl_y``, ``cx``, ``cy``, ``w``, ``h`` and the
distortion stand in each frame or once for all; NeRF-synthetic has only ``camera_angle_x``, the horizontal field of view
in radians. ``applied_transform`` (3 x 4) and ``applied_scale`` say how the world of the original photos was moved
before the file was saved.

``ns-export cameras`` writes another file, ``transforms_train.json``: a list of ``file_path`` and ``transform`` (3 x 4,
the same axes) without intrinsics. Its poses are those of the training, corrected ones too, in the scene's frame.

INRIA's training of 3D Gaussian Splatting writes ``cameras.json`` beside its scenes: a list of cameras with ``id``,
``img_name``, ``width``, ``height``, ``position`` (3), ``rotation`` (3 x 3, camera to world, OpenCV axes), ``fx`` and
``fy``. The principal point is the picture's centre. Poses are in the scene's frame.
"""

from __future__ import annotations

import functools
import math
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.camera_files.cameras import Camera, CameraFile, Motion, finite, matrix, need_count, rigid
from pointsplat_ns.io.files import logger
from pointsplat_ns.system.tensors import DOUBLES, FLOATS


def nerfstudio_cameras(content: dict[str, Any], path: Path) -> CameraFile:
    """The cameras in the JSON of a ``transforms.json``. The size of the photos is looked up if the file has none.
    Raises DataError if a frame has no usable pose or intrinsics, or a camera has no focal length (a panorama)."""
    frames = content["frames"]
    need_count(path, len(frames))
    size = functools.cache(lambda: _size_of_photos(frames[0], path))
    distortion = ("k1", "k2", "k3", "k4", "p1", "p2")
    names = ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y", "camera_model", *distortion)
    found = []
    bent = 0
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise DataError(f"{path}: camera {index} is no frame; expected an object with 'transform_matrix'")
        # A frame may have none of these, or hundreds of others.
        said = {name: frame.get(name, content.get(name)) for name in names}
        found.append(_camera(frame, said, index, path, size))
        bent += said["camera_model"] in ("OPENCV_FISHEYE", "FISHEYE") or any(finite(said[k]) for k in distortion)
    if bent:
        logger.info("%s: the lens distortion of %d of %d cameras is ignored", path, bent, len(found))
    return CameraFile(found, _saved_motion(content, path))


def exported_cameras(content: list[Any], path: Path) -> CameraFile:
    """The cameras in the JSON of ``ns-export cameras``, which has no intrinsics: 1920 x 1080 pixels and 60
    degrees in width are taken, with a warning. Raises DataError if an entry is no camera."""
    need_count(path, len(content))
    width, height, angle = 1920, 1080, 60.0
    focal = 0.5 * width / math.tan(0.5 * math.radians(angle))
    found = []
    for index, entry in enumerate(content):
        entry = entry if isinstance(entry, dict) else {}
        pose = _pose(entry.get("transform"))
        if pose is None:
            raise DataError(f"{path}: camera {index} has no pose; expected 'transform', 3 x 4 numbers")
        name = entry.get("file_path")
        found.append(
            Camera(
                name if isinstance(name, str) else "", pose, (width, height), (focal, focal), (width / 2, height / 2)
            )
        )
    logger.warning(
        "%s: poses without intrinsics; taken for %d x %d pixels and a horizontal field of view of %g degrees",
        path, width, height, angle,
    )  # fmt: skip
    return CameraFile(found)


def _pose(rows: Any) -> list[float] | None:
    """The 16 numbers of a pose of OpenGL's axes in OpenCV's; None if it is none."""
    numbers = matrix(rows, (3, 4), 4)
    if numbers is None:
        return None
    pose = [number for x, y, z, w in numbers for number in (x, -y, -z, w)]
    return pose if len(numbers) == 4 else [*pose, 0.0, 0.0, 0.0, 1.0]


def _camera(frame: dict[str, Any], said: dict[str, Any], index: int, path: Path, size: Any) -> Camera:
    kind = said["camera_model"]
    lenses = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FISHEYE")
    if kind is not None and kind not in lenses:  # one without a focal length
        raise DataError(f"{path}: camera {index} is {str(kind)[:40]!r}; expected one of {', '.join(lenses)}")
    width, height = finite(said["w"]), finite(said["h"])
    if width is None or height is None:
        width, height = size()
    fx = finite(said["fl_x"]) or _focal(width, finite(said["camera_angle_x"]))
    fy = finite(said["fl_y"]) or _focal(height, finite(said["camera_angle_y"])) or fx
    if fx is None or fy is None:
        raise DataError(f"{path}: camera {index} has no focal length; expected a number 'fl_x' or 'camera_angle_x'")
    cx, cy = finite(said["cx"]), finite(said["cy"])
    pose = _pose(frame.get("transform_matrix"))
    if pose is None:
        raise DataError(f"{path}: camera {index} has no pose; expected 'transform_matrix', 4 x 4 numbers")
    name, mask = (text if isinstance(text, str) else "" for text in (frame.get("file_path"), frame.get("mask_path")))
    fisheye = kind in ("OPENCV_FISHEYE", "FISHEYE")
    model = "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV, with k4" if finite(said["k4"]) else "FULL_OPENCV"
    order = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return Camera(
        name,
        pose,
        (width, height),
        (fx, fy),
        (0.5 * width if cx is None else cx, 0.5 * height if cy is None else cy),
        model,
        tuple(finite(said[name]) or 0.0 for name in order),
        mask,
    )


def _focal(side: float, angle: float | None) -> float | None:
    """Focal length, pixels, of a field of view in radians."""
    return 0.5 * side / math.tan(0.5 * angle) if angle is not None and 0 < angle < math.pi else None


def _saved_motion(content: dict[str, Any], path: Path) -> Motion:
    """Transform from the original world to that of the file."""
    rows = content.get("applied_transform")
    if rows is None:
        rows = torch.eye(4, **FLOATS)[:3].tolist()
        if (path.parent / "colmap" / "sparse" / "0").is_dir():  # as nerfstudio takes a file of an early version
            rows = [[0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]]
    scale = finite(content.get("applied_scale", 1.0))
    try:
        transform = torch.tensor(rows, **DOUBLES)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        transform = torch.empty(0, **FLOATS)
    if transform.shape != (3, 4) or scale is None or not 0 < scale:
        raise DataError(
            f"{path}: its 'applied_transform' or 'applied_scale' is not usable; expected 3 x 4 numbers and a number "
            "above 0"
        )
    return Motion(rigid(transform[None], f"{path}: its 'applied_transform'")[0], scale)


def _size_of_photos(frame: Any, path: Path) -> tuple[float, float]:
    """Width and height, pixels, of the first photo if it lies where the file says, else those of NeRF-synthetic."""
    from PIL import Image

    name = frame.get("file_path") if isinstance(frame, dict) else None
    relative = PurePosixPath(name if isinstance(name, str) and "\0" not in name else "")
    if not relative.is_absolute() and ".." not in relative.parts:  # nothing outside of the folder is opened
        for suffix in ("", ".png"):
            photo = path.parent / f"{relative}{suffix}"
            try:
                if photo.is_file():
                    with Image.open(photo) as opened:
                        return opened.width, opened.height
            except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
                continue
    width, height = (800, 800)  # of NeRF-synthetic, whose files do not say them
    logger.info("%s: no 'w' and 'h', and no photo to measure; taken for %d x %d pixels", path, width, height)
    return width, height


def inria_cameras(content: list[Any], path: Path) -> CameraFile:
    """The cameras in the JSON of a ``cameras.json``; a DataError if an entry is no camera."""
    need_count(path, len(content))
    return CameraFile([_inria_camera(entry, index, path) for index, entry in enumerate(content)])


def _inria_camera(entry: Any, index: int, path: Path) -> Camera:
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
