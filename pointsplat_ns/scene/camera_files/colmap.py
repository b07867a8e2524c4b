"""COLMAP models: folders with ``cameras.bin`` and ``images.bin``, or both as ``.txt``.

Poses are world-to-camera: a quaternion wxyz and a translation, OpenCV axes. Focal lengths,
principal point and distortion are read from a camera's parameters. The 2D points of images are
skipped without loading them; text models may lack their lines.

Source: https://colmap.github.io/format.html and COLMAP's list of camera models.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import BinaryIO, NamedTuple

import torch
from torch import Tensor

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import invert_rigid, rotation_matrices
from pointsplat_ns.scene.camera_files.camera_views import (
    MOST_CAMERAS,
    Camera,
    CameraFile,
    Motion,
    need_count,
)
from pointsplat_ns.system.files import logger, one_line
from pointsplat_ns.system.opening import open_regular
from pointsplat_ns.system.tensors import DOUBLES

COLMAP_CAMERAS = {
    "SIMPLE_PINHOLE": (0, 1, 3),
    "PINHOLE": (1, 2, 4),
    "SIMPLE_RADIAL": (2, 1, 4),
    "RADIAL": (3, 1, 5),
    "OPENCV": (4, 2, 8),
    "OPENCV_FISHEYE": (5, 2, 8),
    "FULL_OPENCV": (6, 2, 12),
    "FOV": (7, 2, 5),
    "SIMPLE_RADIAL_FISHEYE": (8, 1, 4),
    "RADIAL_FISHEYE": (9, 1, 5),
    "THIN_PRISM_FISHEYE": (10, 2, 12),
    "RAD_TAN_THIN_PRISM_FISHEYE": (11, 2, 16),
    "SIMPLE_DIVISION": (12, 1, 4),
    "DIVISION": (13, 2, 5),
    "SIMPLE_FISHEYE": (14, 1, 3),
    "FISHEYE": (15, 2, 4),
    "EUCM": (16, 2, 6),
}
"""COLMAP's camera models: number in binary files, number of focal lengths, number of parameters.
The parameters are focal lengths, principal point, distortion, in this order."""

_LONGEST_LINE = 4096
"""Maximum length of a camera or image line and of a photo name, bytes. Lines of points are longer;
they are skipped in pieces."""


class _Image(NamedTuple):
    name: str
    pose: tuple[float, ...]
    """Quaternion wxyz and translation, world to camera."""
    camera: int


def model_folder(path: Path) -> Path | None:
    """The folder of a COLMAP model. ``path`` is one of its two files, the folder itself, the folder
    of all models (``sparse``), or a project with ``sparse/0`` or ``colmap/sparse/0``. None if there
    is no model."""
    files = ("cameras.bin", "images.bin", "cameras.txt", "images.txt")
    if not path.is_dir():
        return path.parent if path.name in files and path.is_file() else None
    folders = (path / below for below in ("", "0", "sparse/0", "sparse", "colmap/sparse/0"))
    return next(
        (folder for folder in folders if any((folder / name).is_file() for name in files)), None
    )


def colmap_cameras(path: Path) -> CameraFile:
    """The cameras of a COLMAP model, ``path`` as for :func:`model_folder`. Raises DataError if
    there is none, a file is missing or damaged, or an image has no usable pose or camera."""
    folder = model_folder(path) or path
    if folder.name == "0" and (
        others := [place.name for place in folder.parent.glob("[1-9]*") if model_folder(place)]
    ):
        logger.warning(
            "%s: one of several models; skipped: %s", folder, ", ".join(sorted(others)[:4])
        )
    kind = next((kind for kind in ("bin", "txt") if (folder / f"images.{kind}").is_file()), "bin")
    cameras_path = folder / f"cameras.{kind}"
    images_path = folder / f"images.{kind}"
    for needed in (cameras_path, images_path):
        if not needed.is_file():
            raise DataError(
                f"{needed}: no such file; expected a COLMAP model: cameras.bin and images.bin, or "
                "both as .txt"
            )
    read_lenses, read_images = (
        (_binary_lenses, _binary_images) if kind == "bin" else (_text_lenses, _text_images)
    )
    try:
        with open_regular(cameras_path) as stream:
            lenses = read_lenses(stream, cameras_path)
        with open_regular(images_path) as stream:
            images = list(read_images(stream, images_path))
    except OSError as error:
        raise DataError(
            f"{folder}: cannot be read ({error.strerror or one_line(error)})"
        ) from error
    need_count(images_path, len(images))
    lost = next((image for image in images if image.camera not in lenses), None)
    if lost is not None:
        raise DataError(
            f"{images_path}: {lost.name[:60]} refers to camera {lost.camera}, which is missing in "
            f"{cameras_path.name}; expected two files of one model"
        )
    poses = torch.tensor([image.pose for image in images], **DOUBLES)
    matrices = invert_rigid(torch.cat([rotation_matrices(poses[:, :4]), poses[:, 4:, None]], dim=2))
    # Quaternions have any length whose square is finite. Others become NaN, and the error names
    # their image.
    lengths = poses[:, :4].norm(dim=1)
    matrices[~((lengths > 1e-6) & (lengths < 1e6))] = torch.nan
    cameras = [
        lenses[image.camera]._replace(name=image.name, pose=pose)
        for image, pose in zip(images, matrices.flatten(1).tolist(), strict=True)
    ]
    return CameraFile(cameras, Motion(torch.eye(4, **DOUBLES)[:3]))


def colmap_points(path: Path) -> Tensor | None:
    """Positions (N, 3), float64, of the 3D points of a COLMAP model, ``path`` as for
    :func:`model_folder`; None if there are no readable points, or more than five million."""
    folder = model_folder(path) or path
    most = 5_000_000
    for kind, read in (("bin", _binary_points), ("txt", _text_points)):
        file = folder / f"points3D.{kind}"
        try:
            if file.is_file():
                with open_regular(file) as stream:
                    points = torch.tensor([*islice(read(stream, file), most + 1)], **DOUBLES).view(
                        -1, 3
                    )
                usable = 0 < len(points) <= most and bool(points.isfinite().all())
                return points if usable else None
        except (OSError, DataError, ValueError, IndexError):
            return None
    return None


def _binary_points(stream: BinaryIO, path: Path) -> Iterator[tuple[float, ...]]:
    """A count, then for each point its number, position, colour, error, track length and track."""
    count = struct.unpack("<Q", _exactly(stream, 8, path))[0]
    for _ in range(count):
        _, x, y, z, *_, seen = struct.unpack("<Q3d3BdQ", _exactly(stream, 51, path))
        _exactly(stream, 8 * min(seen, 1 << 20), path)
        yield x, y, z


def _text_points(stream: BinaryIO, path: Path) -> Iterator[tuple[float, ...]]:
    """The lines "POINT3D_ID X Y Z R G B ERROR TRACK[]", of any length."""
    begins = True
    while line := stream.readline(_LONGEST_LINE):
        if begins and not line.startswith(b"#") and line.strip():
            yield tuple(float(word) for word in line.split(maxsplit=4)[1:4])
        begins = line.endswith(b"\n")


def _lens(name: str, size: tuple[float, float], params: tuple[float, ...]) -> Camera:
    """A COLMAP camera, shared by several images: without a photo and a pose."""
    _, focals, _ = COLMAP_CAMERAS[name]
    focal = (params[0], params[focals - 1])
    centre = (params[focals], params[focals + 1])
    return Camera("", (), size, focal, centre, name, params[focals + 2 :])


def _text_lenses(stream: BinaryIO, path: Path) -> dict[int, Camera]:
    """The lines "CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"."""
    lenses = {}
    for line in _lines(stream, path):
        words = line.split()
        try:
            name = words[1]
            size = (float(words[2]), float(words[3]))
            if name not in COLMAP_CAMERAS:
                raise _no_model(path, name)
            params = tuple(float(word) for word in words[4:])
            if len(params) != COLMAP_CAMERAS[name][2]:
                raise ValueError
            lenses[int(words[0])] = _lens(name, size, params)
        except (ValueError, IndexError) as error:
            raise DataError(
                f"{path}: {line[:60]!r} is not a camera; expected a number, a model, width, height "
                "and parameters"
            ) from error
        need_count(path, len(lenses))
    return lenses


def _text_images(stream: BinaryIO, path: Path) -> Iterator[_Image]:
    """The lines "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME". COLMAP writes a line of points
    after each, which may be empty; other programs leave it out."""
    for count, line in enumerate(_lines(stream, path), 1):
        need_count(path, count)
        words = line.split(maxsplit=9)
        try:
            image = _Image(words[9], tuple(float(word) for word in words[1:8]), int(words[8]))
        except (ValueError, IndexError) as error:
            raise DataError(
                f"{path}: {line[:60]!r} is not an image; expected a number, a quaternion wxyz, a "
                "translation, a camera and a name, with or without a line of points after it"
            ) from error
        yield image
        _skip_points(stream)


def _skip_points(stream: BinaryIO) -> None:
    """Skip the next line if it is empty, or a line "POINTS2D[] as (X, Y, POINT3D_ID)", of any
    length."""
    start = stream.tell()
    piece = stream.readline(_LONGEST_LINE)
    if len(piece) < _LONGEST_LINE and not _are_points(piece.split()):
        stream.seek(start)
        return
    while piece and not piece.endswith(b"\n"):  # longer than the line of an image
        piece = stream.readline(1 << 16)


def _are_points(words: list[bytes]) -> bool:
    """Whether the words of a line are points: triples of two coordinates and a whole number. The
    line of an image has ten words, or a name of several words."""
    if len(words) % 3:
        return False
    try:
        _ = [float(word) for word in words], [int(word) for word in words[2::3]]
    except ValueError:
        return False
    return True


def _lines(stream: BinaryIO, path: Path) -> Iterator[str]:
    """Lines that are neither empty nor comments."""
    while line := stream.readline(_LONGEST_LINE):
        if line.startswith(b"#"):
            while line and not line.endswith(b"\n"):
                line = stream.readline(_LONGEST_LINE)
            continue
        if len(line) == _LONGEST_LINE and not line.endswith(b"\n"):
            raise DataError(
                f"{path}: a line of more than {_LONGEST_LINE} bytes; expected a camera or an image"
            )
        text = line.decode("utf-8", "replace").strip()
        if text:
            yield text


def _binary_lenses(stream: BinaryIO, path: Path) -> dict[int, Camera]:
    """A count, then for each camera its number, model, width, height and parameters."""
    names = {number: name for name, (number, _, _) in COLMAP_CAMERAS.items()}
    lenses = {}
    for _ in range(_count(stream, path, 24)):
        number, model, width, height = struct.unpack("<IiQQ", _exactly(stream, 24, path))
        if model not in names:
            raise _no_model(path, str(model))
        name = names[model]
        params = struct.unpack(
            f"<{COLMAP_CAMERAS[name][2]}d", _exactly(stream, 8 * COLMAP_CAMERAS[name][2], path)
        )
        lenses[number] = _lens(name, (float(width), float(height)), params)
    return lenses


def _binary_images(stream: BinaryIO, path: Path) -> Iterator[_Image]:
    """A count, then for each image its number, quaternion, translation, camera, zero-terminated
    name, number of points and points."""
    total = os.fstat(stream.fileno()).st_size
    for _ in range(_count(stream, path, 73)):
        _, *pose, camera = struct.unpack("<I7dI", _exactly(stream, 64, path))
        start = stream.tell()
        name, end, _ = stream.read(_LONGEST_LINE).partition(b"\0")
        if not end:
            raise DataError(
                f"{path}: image name does not end within {_LONGEST_LINE} bytes; expected a COLMAP "
                "model"
            )
        stream.seek(start + len(name) + 1)
        (points,) = struct.unpack("<Q", _exactly(stream, 8, path))
        size = 24 * points  # x, y and the 3D point's number
        if size > total - stream.tell():
            raise DataError(
                f"{path}: declares an image with {points} points, more than the file has room for; "
                "it is damaged or incomplete"
            )
        stream.seek(size, os.SEEK_CUR)
        yield _Image(name.decode("utf-8", "replace"), tuple(pose), camera)


def _count(stream: BinaryIO, path: Path, least: int) -> int:
    """The count at the start of a binary file, checked against the file size; an entry has at least
    ``least`` bytes."""
    (count,) = struct.unpack("<Q", _exactly(stream, 8, path))
    room = (os.fstat(stream.fileno()).st_size - 8) // least
    if not 0 < count <= min(room, MOST_CAMERAS):
        raise DataError(
            f"{path}: declares {count} entries, has room for {room}; expected 1 to {MOST_CAMERAS}, "
            "as COLMAP writes them"
        )
    return count


def _exactly(stream: BinaryIO, size: int, path: Path) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise DataError(f"{path}: ends too early; it is damaged or incomplete")
    return data


def _no_model(path: Path, name: str) -> DataError:
    return DataError(
        f"{path}: a camera of model {name[:40]}; expected one of {', '.join(COLMAP_CAMERAS)}"
    )
