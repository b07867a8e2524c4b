"""Reads and checks scenes in the Replica layouts of NICE-SLAM and of Semantic-NeRF.

NICE-SLAM: a scene folder holds ``traj.txt`` (one camera-to-world per line, 16 numbers, row by row, OpenCV
axes: x right, y down, z forward), ``results/frame*.jpg|png`` and, optionally,
``results/depth*.png`` (16 bit; depth along the optical axis = value / ``scale``; 0 unknown). The
intrinsics are in ``cam_params.json``, in the scene folder or in the one above it. Poses belong to
frames by order: line k is the pose of the k-th frame by number.

Semantic-NeRF: a sequence (``room_0/Sequence_1``) holds ``traj_w_c.txt``, ``rgb/rgb_0.png`` and so on, and optionally
``depth/depth_0.png`` (16 bit, millimetres), with poses as above. Its cameras have a horizontal field of view of 90
degrees, which no file says; a ``cam_params.json`` overrides it.

nerfstudio is not imported.
"""

import logging
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import read_text
from pointsplat_ns.io.pictures import exif_hint
from pointsplat_ns.nerfstudio_plugin.replica.cam_params import (
    FARTHEST,
    PinholeParams,
    cam_params_paths,
    read_cam_params,
)

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class FileNames:
    """Names of the files in a scene folder."""

    trajectory: str
    photos: str
    """Folder of the photos."""
    photo: str
    """Pattern of a photo's name, with its number as the first group."""
    depths: str
    """Folder of the depth images."""
    depth: str
    """Pattern of a depth image's name, likewise."""
    example: str
    """A photo's path."""


NICE_SLAM = FileNames(
    "traj.txt", "results", r"frame(\d+)\.(?:jpg|jpeg|png)", "results", r"depth(\d+)\.png", "results/frame000000.jpg"
)
SEMANTIC_NERF = FileNames(
    "traj_w_c.txt", "rgb", r"rgb_(\d+)\.(?:jpg|jpeg|png)", "depth", r"depth_(\d+)\.png", "rgb/rgb_0.png"
)


def file_names(folder: Path) -> FileNames | None:
    """The layout of a scene folder, by its trajectory or photos; None if it is none."""
    for names in (NICE_SLAM, SEMANTIC_NERF):
        if (folder / names.trajectory).is_file():
            return names
    return NICE_SLAM if (folder / NICE_SLAM.photos).is_dir() else None


@dataclass(frozen=True)
class ReplicaScene:
    """A checked scene: paths and numbers, no pixels.

    Attributes:
        folder: The scene folder.
        params: Intrinsics and depth scale.
        numbers: Frame numbers from the file names, ascending.
        photos: One photo per number.
        depths: One depth image per number, or None if the scene has no depth.
        poses: float64 (F, 4, 4) camera-to-world, OpenCV axes, rotations exactly orthonormal.
    """

    folder: Path
    params: PinholeParams
    numbers: tuple[int, ...]
    photos: tuple[Path, ...]
    depths: tuple[Path, ...] | None
    poses: np.ndarray  # [F, 4, 4]

    def __len__(self) -> int:
        return len(self.numbers)

    def select(self, indices: list[int]) -> "ReplicaScene":
        """The same scene with only the frames at these positions, in this order."""
        return replace(
            self,
            numbers=tuple(self.numbers[i] for i in indices),
            photos=tuple(self.photos[i] for i in indices),
            depths=None if self.depths is None else tuple(self.depths[i] for i in indices),
            poses=self.poses[indices],
        )


def load_replica(folder: Path, check_sizes: bool = True) -> ReplicaScene:
    """Read and check a scene. Image headers are read, but no image is decoded; with ``check_sizes``, every photo's size
    is compared with ``cam_params.json``.

    Frames whose pose is not finite, or farther than :data:`FARTHEST` (lost tracking), are dropped, with one warning. A
    DataError names a file that is missing, unreadable or inconsistent.
    """
    folder = Path(folder)
    hint = "a scene folder holds traj.txt and results/frame*.jpg, or traj_w_c.txt and rgb/rgb_*.png"
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; {hint}")
    names = file_names(folder)
    if names is None:
        scenes = sorted(
            {p.parent.name for each in (NICE_SLAM, SEMANTIC_NERF) for p in folder.glob(f"*/{each.trajectory}")}
        )
        hint = f"it contains the scenes {', '.join(scenes)}: name one of them" if scenes else hint
        raise DataError(f"{folder}: not a scene of the Replica layout; {hint}")
    trajectory = folder / names.trajectory
    photos = _numbered(folder / names.photos, names.photo, f"photos such as {names.example}")
    if not photos:
        raise DataError(f"{folder / names.photos}: no photo found; expected {names.example} and so on")
    has_depths = (folder / names.depths).is_dir()
    depths = _numbered(folder / names.depths, names.depth, "depth images") if has_depths else {}
    numbers = sorted(photos)
    params = _params(folder, names, photos[numbers[0]])
    poses = read_trajectory(trajectory)
    if len(poses) != len(numbers):
        raise DataError(
            f"{trajectory}: {len(poses)} poses for {len(numbers)} photos in {folder / names.photos}; "
            f"expected one line per photo{_missing_hint(numbers, len(poses))}"
        )
    if depths:
        missing = [n for n in numbers if n not in depths]
        if missing:
            lacking = _some([photos[n].name for n in missing])
            raise DataError(
                f"{folder / names.depths}: {len(missing)} of {len(numbers)} photos have no depth image ({lacking}); "
                "restore them, or remove all depth images to go without depth"
            )
    finite = (np.abs(poses) < FARTHEST).all(axis=(1, 2))  # NaN fails too
    if not finite.all():
        lines = [int(i) + 1 for i in np.flatnonzero(~finite)]
        if not finite.any():
            raise DataError(
                f"{trajectory}: none of the {len(poses)} poses is finite; expected numbers below {FARTHEST:g}"
            )
        logger.warning(
            "%s: %d of %d poses hold NaN, Inf or numbers beyond 1e18 (line %s): their frames are left out",
            trajectory,
            len(lines),
            len(poses),
            _some([str(i) for i in lines]),
        )
    keep = [int(i) for i in np.flatnonzero(finite)]
    rigid = _rigid(poses[keep], [i + 1 for i in keep], trajectory)
    numbers = [numbers[i] for i in keep]
    scene = ReplicaScene(
        folder=folder,
        params=params,
        numbers=tuple(numbers),
        photos=tuple(photos[n] for n in numbers),
        depths=tuple(depths[n] for n in numbers) if depths else None,
        poses=rigid,
    )
    if check_sizes:
        for path in scene.photos:
            _check_size(path, _open_image(path).size, params)
    return scene


def _params(folder: Path, names: FileNames, photo: Path) -> PinholeParams:
    """Intrinsics of a scene: those of its file, or those that all sequences of Semantic-NeRF have."""
    if names is SEMANTIC_NERF and not any(path.is_file() for path in cam_params_paths(folder)):
        width, height = _open_image(photo).size
        return PinholeParams(width, height, width / 2, width / 2, (width - 1) / 2, (height - 1) / 2, 1000.0, photo)
    return read_cam_params(folder)


def read_trajectory(path: Path) -> np.ndarray:
    """The poses of a ``traj.txt``: float64 (F, 4, 4), camera-to-world, not yet checked to be rigid or finite. Blank
    lines are ignored. Raises DataError if the file is missing, or a line is not 16 numbers."""
    try:
        text = read_text(path, 1 << 28)
    except FileNotFoundError:
        raise DataError(f"{path}: not found; expected one camera-to-world (16 numbers) per line") from None
    except (OSError, ValueError):
        raise DataError(f"{path}: not a text file; expected one camera-to-world (16 numbers) per line") from None
    rows = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words:
            continue
        if len(words) != 16:
            raise DataError(f"{path}: line {number} has {len(words)} values; expected 16 (a 4 x 4 matrix, row by row)")
        try:
            rows.append([float(word) for word in words])
        except ValueError as error:
            raise DataError(f"{path}: line {number}: {error}; expected 16 numbers") from None
    if not rows:
        raise DataError(f"{path}: empty; expected one camera-to-world (16 numbers) per line")
    return np.asarray(rows, dtype=np.float64).reshape(-1, 4, 4)


def read_photo(path: Path, params: PinholeParams) -> np.ndarray:
    """One photo, uint8 (H, W, 3), sRGB. Raises DataError if it is missing or broken, not of 8 bits a channel, or of
    another size than ``params``."""
    image = _open_image(path)
    _check_size(path, image.size, params)
    if image.mode.startswith(("I", "F")):
        raise DataError(f"{path}: pixels of mode {image.mode}; expected 8 bits a channel; convert the photo")
    return np.asarray(_decoded(path, image).convert("RGB"))


def read_depth(path: Path, params: PinholeParams) -> np.ndarray:
    """One depth image, float32 (H, W), scene units along the optical axis, 0 where unknown. Raises DataError if it is
    missing or broken, not of 16 bits, or of another size than ``params``."""
    image = _open_image(path)
    _check_size(path, image.size, params)
    if image.mode not in ("I;16", "I;16B", "I"):
        raise DataError(f"{path}: pixels of mode {image.mode}; expected a 16-bit grey depth image")
    raw = np.asarray(_decoded(path, image)).astype(np.int64)
    depth = raw.astype(np.float32) / np.float32(params.scale)
    depth[np.isin(raw, (0, 65535))] = 0.0  # empty and saturated: not measured
    return depth


def _open_image(path: Path):
    from PIL import Image, UnidentifiedImageError

    try:
        return Image.open(path)
    except FileNotFoundError:
        raise DataError(f"{path}: not found") from None
    except (UnidentifiedImageError, OSError) as error:
        raise DataError(f"{path}: not a readable picture ({type(error).__name__}); restore the file") from None


def _decoded(path: Path, image):
    try:
        image.load()
    except (OSError, SyntaxError, ValueError) as error:
        raise DataError(f"{path}: broken picture ({error}); restore the file") from None
    return image


def _check_size(path: Path, size: tuple[int, int], params: PinholeParams) -> None:
    if size != (params.width, params.height):
        raise DataError(
            f"{path}: {size[0]} x {size[1]} pixels; expected {params.width} x {params.height} as in {params.path}"
            + exif_hint(path, (params.width, params.height))
        )


def _numbered(folder: Path, pattern: str, wanted: str) -> dict[int, Path]:
    """The files of a folder whose names match, by the number in the name."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; expected {wanted} in it")
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = re.fullmatch(pattern, path.name, re.IGNORECASE)
        if match is None:
            continue
        number = int(match.group(1))
        if number in found:
            raise DataError(f"{folder}: {found[number].name} and {path.name} have the same number; keep one of them")
        found[number] = path
    return found


def _missing_hint(numbers: list[int], poses: int) -> str:
    """Names the photos that are missing in the numbering, if that explains the difference in count."""
    last = max(numbers[0] + poses - 1, numbers[-1])
    if len(numbers) >= poses or last - numbers[0] + 1 != poses:
        return ""
    present = set(numbers)
    gaps = [f"frame{n:06d}" for n in range(numbers[0], last + 1) if n not in present]
    return f"; missing: {_some(gaps)}"


def _some(items: list[str], limit: int = 5) -> str:
    return ", ".join(items[:limit]) + (f" and {len(items) - limit} more" if len(items) > limit else "")


def _rigid(poses: np.ndarray, lines: list[int], path: Path) -> np.ndarray:
    """Poses with each rotation replaced by the nearest orthonormal one (polar factor, by SVD). Raises DataError if the
    last row is not (0, 0, 0, 1), the drift is too large, or the axes are mirrored."""
    last = np.abs(poses[:, 3] - np.array([0.0, 0.0, 0.0, 1.0])).max(axis=1)
    rotation = poses[:, :3, :3]
    drift = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
    mirrored = np.linalg.det(rotation) < 0
    for k, line in enumerate(lines):
        if last[k] > 1e-6:
            row = " ".join(f"{v:g}" for v in poses[k, 3])
            raise DataError(f"{path}: line {line} ends in {row}; expected 0 0 0 1 (a matrix written row by row)")
        # Few digits cause a drift of 1e-7 to 1e-4. Beyond one percent the matrix holds a scale or a shear.
        if drift[k] > 1e-2:
            raise DataError(
                f"{path}: line {line} is not a rigid pose (R^T R is off by {drift[k]:.2g}); "
                "expected a rotation within 0.01"
            )
        if mirrored[k]:
            raise DataError(f"{path}: line {line} mirrors the axes (determinant -1); expected a rotation")
    u, _, vt = np.linalg.svd(rotation)
    rigid = np.tile(np.eye(4), (len(poses), 1, 1))
    rigid[:, :3, :3] = u @ vt
    rigid[:, :3, 3] = poses[:, :3, 3]
    return rigid
