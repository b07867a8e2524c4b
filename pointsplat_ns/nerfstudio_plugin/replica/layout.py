"""Reads scenes in the Replica layouts of NICE-SLAM and of Semantic-NeRF, without nerfstudio.

NICE-SLAM: a scene folder holds ``traj.txt`` (one camera-to-world per line, 16 numbers, row by row,
OpenCV axes: x right, y down, z forward; line k is the pose of the k-th frame by number),
``results/frame*.jpg|png`` and, optionally, ``results/depth*.png`` (16 bit; depth along the optical
axis = value / ``scale``; 0 unknown). The intrinsics are in ``cam_params.json``, in the scene folder
or in the one above it.

Semantic-NeRF: a sequence (``room_0/Sequence_1``) holds ``traj_w_c.txt``, ``rgb/rgb_0.png`` and so
on, and optionally ``depth/depth_0.png`` (16 bit, millimetres), with poses as above. Its cameras
have a horizontal field of view of 90 degrees, which no file says; a ``cam_params.json`` overrides
it.
"""

import json
import re
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pointsplat_ns.errors import DataError
from pointsplat_ns.scene.image_files import IMAGE_ERRORS, exif_hint, open_image
from pointsplat_ns.system.files import logger, one_line, read_text

FARTHEST = 1e18
"""Poses with larger numbers count as lost tracking: float32, in which scenes are trained, cannot
square them."""


class Layout(NamedTuple):
    """Names in a scene folder: of the trajectory, of folders, and of files in these, whose first
    group is a number."""

    trajectory: str
    photos: str
    photo: str
    depths: str
    depth: str


NICE_SLAM = Layout(
    "traj.txt", "results", r"frame(\d+)\.(?:jpg|jpeg|png)", "results", r"depth(\d+)\.png"
)
SEMANTIC_NERF = Layout(
    "traj_w_c.txt", "rgb", r"rgb_(\d+)\.(?:jpg|jpeg|png)", "depth", r"depth_(\d+)\.png"
)


@dataclass(frozen=True)
class PinholeParams:
    """Intrinsics as in ``cam_params.json``, in pixels, without a pixel-centre correction."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    scale: float  # raw depth counts per scene unit
    path: Path  # the file they come from

    @property
    def principal_point(self) -> tuple[float, float]:
        """Principal point in pixels from the corner of the image, as in rasterizers. If it is
        exactly (w / 2, h / 2) in the file, it is that there, too. Otherwise the centre of the first
        pixel is 0, as in Replica's own file (599.5 of 1200) and in OpenCV."""
        shift = 0.0 if (self.cx, self.cy) == (self.width / 2, self.height / 2) else 0.5
        return self.cx + shift, self.cy + shift


@dataclass(frozen=True)
class ReplicaScene:
    """A scene: paths and numbers, no pixels."""

    folder: Path
    params: PinholeParams
    photos: tuple[Path, ...]
    """By ascending number."""
    depths: tuple[Path, ...] | None
    """One depth image for each photo, or None if one has none."""
    poses: np.ndarray  # [F, 4, 4]
    """float64, camera-to-world, OpenCV axes, rotations exactly orthonormal."""

    def __len__(self) -> int:
        return len(self.photos)

    def select(self, indices: list[int]) -> "ReplicaScene":
        """The same scene with only the frames at these positions, in this order."""
        return replace(
            self,
            photos=tuple(self.photos[i] for i in indices),
            depths=None if self.depths is None else tuple(self.depths[i] for i in indices),
            poses=self.poses[indices],
        )


def load_replica(folder: Path) -> ReplicaScene:
    """Read a scene, but no photo. Frames whose pose is not finite, or farther than :data:`FARTHEST`
    (lost tracking), are dropped, with one warning. A DataError names a file that is missing,
    unreadable or inconsistent."""
    hint = "a scene folder holds traj.txt and results/frame*.jpg, or traj_w_c.txt and rgb/rgb_*.png"
    layouts = (NICE_SLAM, SEMANTIC_NERF)
    names = next((each for each in layouts if (folder / each.trajectory).is_file()), None)
    if names is None:
        scenes = sorted(
            {path.parent.name for each in layouts for path in folder.glob(f"*/{each.trajectory}")}
        )
        hint = f"it contains the scenes {', '.join(scenes)}: name one of them" if scenes else hint
        raise DataError(f"{folder}: no {' or '.join(each.trajectory for each in layouts)}; {hint}")
    trajectory = folder / names.trajectory
    photos = _numbered(folder / names.photos, names.photo)
    depths = _numbered(folder / names.depths, names.depth)
    if not photos:
        raise DataError(f"{folder / names.photos}: no photo found; {hint}")
    numbers = sorted(photos)
    poses = read_trajectory(trajectory)
    if len(poses) != len(numbers):
        raise DataError(
            f"{trajectory}: {len(poses)} poses for {len(numbers)} photos in "
            f"{folder / names.photos}; expected one line per photo"
        )
    finite = (np.abs(poses) < FARTHEST).all(axis=(1, 2))  # NaN fails too
    keep = np.flatnonzero(finite).tolist()
    lost = (np.flatnonzero(~finite) + 1).tolist()
    if lost:
        some = ", ".join(map(str, lost[:5])) + (" and more" if lost[5:] else "")
        what = (
            f"{trajectory}: {len(lost)} of {len(poses)} poses hold NaN, Inf or numbers beyond "
            f"{FARTHEST:g}"
        )
        if not keep:
            raise DataError(f"{what}; expected one that does not")
        logger.warning("%s (line %s): their frames are left out", what, some)
    return ReplicaScene(
        folder=folder,
        params=_params(folder, names, photos[numbers[0]]),
        photos=tuple(photos[numbers[i]] for i in keep),
        depths=tuple(depths[numbers[i]] for i in keep) if depths.keys() >= photos.keys() else None,
        poses=_rigid(poses[keep], [i + 1 for i in keep], trajectory),
    )


def _params(folder: Path, names: Layout, photo: Path) -> PinholeParams:
    """Intrinsics from the ``cam_params.json`` in the scene folder or the folder above it, or those
    that all sequences of Semantic-NeRF have. Raises DataError if there are none, or a number is
    missing or out of range."""
    places = folder / "cam_params.json", folder.absolute().parent / "cam_params.json"
    wanted = (
        'expected {"camera": {"w", "h", "fx", "fy", "cx", "cy", "scale"}} with positive numbers'
    )
    path = next((place for place in places if place.is_file()), None)
    if path is None and names is SEMANTIC_NERF:
        with _opened(photo) as image:
            width, height = image.size
        return PinholeParams(
            width, height, width / 2, width / 2, (width - 1) / 2, (height - 1) / 2, 1000.0, photo
        )
    if path is None:
        raise DataError(f"{places[0]}: not found, nor {places[1]}; {wanted} in one of them")
    try:
        camera = json.loads(read_text(path))["camera"]
        w, h, fx, fy, cx, cy, scale = (
            float(camera[key]) for key in ("w", "h", "fx", "fy", "cx", "cy", "scale")
        )
        positive = (
            all(0 < value < FARTHEST for value in (w, h, fx, fy, scale))
            and abs(cx) + abs(cy) < FARTHEST
        )
        if not positive or w % 1 or h % 1:  # NaN fails too
            raise ValueError(f"{camera!s:.200}")
    except (OSError, ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{path}: {type(error).__name__}: {one_line(error)}; {wanted}, whole ones of pixels"
        ) from None
    return PinholeParams(int(w), int(h), fx, fy, cx, cy, scale, path)


def read_trajectory(path: Path) -> np.ndarray:
    """The poses of a ``traj.txt``, float64 (F, 4, 4), not yet checked to be rigid or finite. Raises
    DataError if the file cannot be read, or a line is not 16 numbers."""
    wanted = "expected one camera-to-world per line (16 numbers, a 4 x 4 matrix, row by row)"
    try:
        lines = read_text(path, 1 << 28).splitlines()
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {one_line(error)}; {wanted}") from None
    rows = []
    for number, line in enumerate(lines, start=1):
        words = line.replace(",", " ").split()
        try:
            if len(words) not in (0, 16):
                raise ValueError(f"{len(words)} values")
            rows += [[float(word) for word in words]] if words else []
        except ValueError as error:
            raise DataError(f"{path}: line {number}: {error}; {wanted}") from None
    if not rows:
        raise DataError(f"{path}: empty; {wanted}")
    return np.asarray(rows, dtype=np.float64).reshape(-1, 4, 4)


def read_photo(path: Path, params: PinholeParams) -> np.ndarray:
    """One photo, uint8 (H, W, 3), sRGB. Raises DataError if it is missing, broken or of another
    size than ``params``."""
    with _decoded(path, params) as image:
        return np.asarray(image.convert("RGB"))


def read_depth(path: Path, params: PinholeParams) -> np.ndarray:
    """One depth image, float32 (H, W), scene units along the optical axis, 0 where unknown. Raises
    DataError if it is missing or broken, not of 16 bits, or of another size than ``params``."""
    with _decoded(path, params) as image:
        if image.mode not in ("I;16", "I;16B", "I"):
            raise DataError(
                f"{path}: pixels of mode {image.mode}; expected a 16-bit grey depth image"
            )
        raw = np.asarray(image).astype(np.int64)
    depth = raw.astype(np.float32) / np.float32(params.scale)
    depth[np.isin(raw, (0, 65535))] = 0.0  # empty and saturated: not measured
    return depth


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """The image of a file, whose pixels are not decoded. Raises DataError if it cannot be read."""
    with ExitStack() as stack:
        try:
            image = stack.enter_context(open_image(path))
        except IMAGE_ERRORS as error:
            raise DataError(
                f"{path}: not a readable picture ({one_line(error)}); restore the file"
            ) from None
        yield image


@contextmanager
def _decoded(path: Path, params: PinholeParams) -> Iterator[Any]:
    """The same with its pixels. Raises DataError, too, if it is broken or of another size than
    ``params``."""
    with _opened(path) as image:
        wanted = (params.width, params.height)
        if image.size != wanted:
            raise DataError(
                f"{path}: {image.width} x {image.height} pixels; expected {wanted[0]} x {wanted[1]}"
                f" as in {params.path}" + exif_hint(path, wanted)
            )
        try:
            image.load()
        except IMAGE_ERRORS as error:
            raise DataError(
                f"{path}: broken picture ({one_line(error)}); restore the file"
            ) from None
        yield image


def _numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of a folder whose names match, by the number in the name; none if there is no such
    folder."""
    matches = (
        (path, re.fullmatch(pattern, path.name, re.IGNORECASE)) for path in sorted(folder.glob("*"))
    )
    return {int(match.group(1)): path for path, match in matches if match}


def _rigid(poses: np.ndarray, lines: list[int], path: Path) -> np.ndarray:
    """Poses with each rotation replaced by the nearest orthonormal one (polar factor, by SVD).
    Raises DataError if a matrix is no rotation and position, such as one written column by column.
    Few digits cause a drift of 1e-7 to 1e-4; beyond one percent the matrix holds a scale or a
    shear."""
    rotation = poses[:, :3, :3]
    sound = np.abs(poses[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1) <= 1e-6
    sound &= np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2)) <= 1e-2
    sound &= np.linalg.det(rotation) > 0
    if not sound.all():
        raise DataError(
            f"{path}: line {lines[int(np.argmin(sound))]} is no rigid pose; expected a rotation, "
            "within 0.01, a position and the last row 0 0 0 1, row by row"
        )
    u, _, vt = np.linalg.svd(rotation)
    rigid = np.tile(np.eye(4), (len(poses), 1, 1))
    rigid[:, :3, :3] = u @ vt
    rigid[:, :3, 3] = poses[:, :3, 3]
    return rigid
