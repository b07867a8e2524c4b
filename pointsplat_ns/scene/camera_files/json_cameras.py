"""Cameras in JSON: ``transforms.json`` of nerfstudio and ``cameras.json`` of INRIA.

``transforms.json`` is nerfstudio's and instant-ngp's format. Each of its ``frames`` has a
``transform_matrix``, camera to world, OpenGL axes (x right, y up, z back). ``fl_x``, ``fl_y``,
``cx``, ``cy``, ``w``, ``h`` and the distortion are given per frame or once for all frames;
``camera_angle_x``, the horizontal field of view in radians, may replace focal lengths. Without
``w`` and ``h``, as in scenes of Blender for NeRF, the photo's header gives the size.
``applied_transform`` (3 x 4) and ``applied_scale`` are the transform from the world of the original
photos to that of the file.

INRIA's training of 3D Gaussian Splatting writes ``cameras.json`` beside its scenes: a list of
cameras with ``id``, ``img_name``, ``width``, ``height``, ``position`` (3), ``rotation`` (3 x 3,
camera to world, OpenCV axes), ``fx`` and ``fy``. The principal point is the image centre. Poses are
in the scene's frame.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.scene.camera_files.camera_views import (
    Camera,
    CameraFile,
    Motion,
    finite,
    matrix,
    need_count,
    photo_file,
    rigid,
)
from pointsplat_ns.scene.image_files import IMAGE_ERRORS, open_image
from pointsplat_ns.system.files import one_line
from pointsplat_ns.system.tensors import DOUBLES, FLOATS


def nerfstudio_cameras(content: dict[str, Any], path: Path) -> CameraFile:
    """The cameras of a ``transforms.json``. Raises DataError if a frame has no usable pose or
    intrinsics, or a camera has no focal length (a panorama)."""
    frames = content["frames"]
    need_count(path, len(frames))
    distortion = ("k1", "k2", "k3", "k4", "p1", "p2")
    names = (
        "fl_x",
        "fl_y",
        "cx",
        "cy",
        "w",
        "h",
        "camera_angle_x",
        "camera_angle_y",
        "camera_model",
        *distortion,
    )
    found = []
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise DataError(
                f"{path}: camera {index} is not a frame; expected an object with 'transform_matrix'"
            )
        # A frame may lack all of these, and have hundreds of other keys.
        said = {name: frame.get(name, content.get(name)) for name in names}
        found.append(_camera(frame, said, index, path))
    return CameraFile(found, _saved_motion(content, path))


def _pose(rows: Any) -> list[float] | None:
    """A pose with OpenGL axes as 16 numbers with OpenCV axes; None if it is not a pose."""
    numbers = matrix(rows, (3, 4), 4)
    if numbers is None:
        return None
    pose = [number for x, y, z, w in numbers for number in (x, -y, -z, w)]
    return pose if len(numbers) == 4 else [*pose, 0.0, 0.0, 0.0, 1.0]


def _camera(frame: dict[str, Any], said: dict[str, Any], index: int, path: Path) -> Camera:
    kind = said["camera_model"]
    lenses = (
        "SIMPLE_PINHOLE",
        "PINHOLE",
        "SIMPLE_RADIAL",
        "RADIAL",
        "OPENCV",
        "OPENCV_FISHEYE",
        "FISHEYE",
    )
    if kind is not None and kind not in lenses:  # a model without a focal length
        raise DataError(
            f"{path}: camera {index} is {str(kind)[:40]!r}; expected one of {', '.join(lenses)}"
        )
    name, mask = (
        text if isinstance(text, str) else ""
        for text in (frame.get("file_path"), frame.get("mask_path"))
    )
    width = finite(said["w"])
    height = finite(said["h"])
    if width is None or height is None:
        width, height = _size_of_photo(name, index, path)
    fx = finite(said["fl_x"]) or _focal(width, finite(said["camera_angle_x"]))
    fy = finite(said["fl_y"]) or _focal(height, finite(said["camera_angle_y"])) or fx
    if fx is None or fy is None:
        raise DataError(
            f"{path}: camera {index} has no focal length; expected a number 'fl_x' or "
            "'camera_angle_x'"
        )
    cx = finite(said["cx"])
    cy = finite(said["cy"])
    pose = _pose(frame.get("transform_matrix"))
    if pose is None:
        raise DataError(
            f"{path}: camera {index} has no pose; expected 'transform_matrix', 4 x 4 numbers"
        )
    fisheye = kind in ("OPENCV_FISHEYE", "FISHEYE")
    model = (
        "OPENCV_FISHEYE"
        if fisheye
        else "FULL_OPENCV, with k4"
        if finite(said["k4"])
        else "FULL_OPENCV"
    )
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


def photo_folders(path: Path) -> list[Path]:
    """Folders searched for the photos of a JSON file: its own, and ScanNet++'s."""
    return [path.parent, path.absolute().parent.parent / "resized_images"]


def _size_of_photo(name: str, index: int, path: Path) -> tuple[float, float]:
    """Width and height in the header of a camera's photo, pixels."""
    photo = photo_file(photo_folders(path), name)
    found = f"its photo {name[:60]!r} is not beside the file"
    if photo is not None:
        try:
            with open_image(photo) as image:
                width, height = image.size
                return float(width), float(height)
        except IMAGE_ERRORS as error:
            found = f"its photo {name[:60]!r} cannot be read ({one_line(error, 60)})"
    raise DataError(
        f"{path}: camera {index} has no size, and {found}; expected numbers 'w' and 'h', pixels, "
        "or the photo"
    )


def _focal(side: float, angle: float | None) -> float | None:
    """Focal length, pixels, for a field of view in radians."""
    return 0.5 * side / math.tan(0.5 * angle) if angle is not None and 0 < angle < math.pi else None


def _saved_motion(content: dict[str, Any], path: Path) -> Motion:
    """Transform from the original world to the file's."""
    rows = content.get("applied_transform")
    if rows is None:
        rows = torch.eye(4, **FLOATS)[:3].tolist()
    scale = finite(content.get("applied_scale", 1.0))
    try:
        transform = torch.tensor(rows, **DOUBLES)
    except (ValueError, TypeError, RuntimeError, OverflowError):
        transform = torch.empty(0, **FLOATS)
    if transform.shape != (3, 4) or scale is None or not 0 < scale:
        raise DataError(
            f"{path}: its 'applied_transform' or 'applied_scale' is not usable; expected 3 x 4 "
            "numbers and a number above 0"
        )
    return Motion(rigid(transform[None], f"{path}: its 'applied_transform'")[0], scale)


def inria_cameras(content: list[Any], path: Path) -> CameraFile:
    """The cameras of a ``cameras.json``. Raises DataError if an entry is not a camera."""
    need_count(path, len(content))
    return CameraFile([_inria_camera(entry, index, path) for index, entry in enumerate(content)])


def _inria_camera(entry: Any, index: int, path: Path) -> Camera:
    entry = entry if isinstance(entry, dict) else {}
    rotation = matrix(entry.get("rotation"), (3,), 3)
    position = matrix([entry.get("position")], (1,), 3)
    if rotation is None or position is None:
        raise DataError(
            f"{path}: camera {index} has no pose; expected 'rotation', 3 x 3 numbers, and "
            "'position', 3 numbers, as 3DGS training writes them"
        )
    width, height, fx, fy = (finite(entry.get(name)) for name in ("width", "height", "fx", "fy"))
    if width is None or height is None or fx is None or fy is None:
        raise DataError(
            f"{path}: camera {index} has no intrinsics; expected numbers 'width', 'height', 'fx' "
            "and 'fy'"
        )
    rows = [[*row, place] for row, place in zip(rotation, position[0], strict=True)]
    name = entry.get("img_name")
    return Camera(
        name if isinstance(name, str) else "",
        [*sum(rows, []), 0.0, 0.0, 0.0, 1.0],
        (width, height),
        (fx, fy),
        (0.5 * width, 0.5 * height),
    )
