"""Captures with poses, public on GitHub, that views without poses are measured on; and how each is
made ready to train.

    python -m lab.judge.captures                                  # the list, with the commands of
    each capture

    git clone https://github.com/mamechun/gs_data clone && git -C clone checkout 57e50c56a1
    python -m lab.judge.captures meeting clone captures/meeting   # photos, transforms.json, seed
    points ns-train splatfacto-cpu --experiment-name meeting --max-num-iterations 2000 --data
    captures/meeting \\
        nerfstudio-data --eval-mode interval --eval-interval 8
    python -m lab.judge.without_poses outputs/meeting/splatfacto-cpu/RUN

Photos become pinhole pictures of one size, without distortion. Every eighth is held out. Whether a
capture is for tuning or judges stands in ``lab/common/scenes.py``, and was decided before the first
measurement. The captures are no part of this project, and most state no licence: fetch them from
there.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import tyro
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from lab.common.printing import console, start, table
from lab.common.scenes import group_of
from pointsplat_ns.errors import SceneError
from pointsplat_ns.system.files import write_json

Array = NDArray[np.float64]

RATIO = 0.75
NEAR = 1.5
REACH = 3
DEGREES = 1.5
"""Seed points: largest ratio of the two best matches' distances, largest distance from the epipolar
line in pixels, photos that each is matched with, and least angle between two rays."""

KEYPOINTS = 2000
"""Largest number of keypoints of a photo."""


@dataclass(frozen=True)
class Capture:
    """Posed photos in a public repository."""

    repository: str  # owner/name on GitHub
    commit: str
    photos: str
    """Folder of the photos."""
    poses: str
    """A COLMAP model's folder, or a ``transforms.json``."""
    count: int
    """Photos with a pose."""
    size: tuple[int, int]  # width and height of the photos, pixels
    kind: Literal["room", "object in a room", "object", "outdoors"]
    shows: str
    licence: str = "none stated"
    opencv: bool = False
    """Whether the matrices of ``transforms.json`` have OpenCV axes, not those of OpenGL."""
    first: int | None = None
    """Number of photos, by name, whose poses are right; None for all."""


CAPTURES = {
    "office": Capture(
        repository="antoniocarevic/diplomski123",
        commit="e334a3c8dcbb2dd9c3050eff0b508d620d3f29ba",
        photos="images",
        poses="transforms.json",
        count=50,
        size=(1080, 1920),
        kind="room",
        shows="an office of two desks, seen from its middle all round, sharp",
        opencv=True,
        # of 68: the poses of the others jump, and end 30 times as far away as the room is large
        first=50,
    ),
    "room35": Capture(
        repository="sabinleee/REAL",
        commit="c889c437571acef58a5348f13176746fc369bffb",
        photos="data/room/images",
        poses="data/room/sparse/0",
        count=35,
        size=(1920, 1080),
        kind="room",
        shows="a studio flat with table, lamp, curtains; wide lens",
        licence="MIT",
    ),
    "meeting": Capture(
        repository="mamechun/gs_data",
        commit="57e50c56a1e601e468e012e0814187e5f698825b",
        photos="dense/0/images",
        poses="dense/0/sparse",
        count=128,
        size=(750, 1000),
        kind="room",
        shows="a meeting room with lockers, table, ceiling and bare walls, seen all round",
    ),
    "drone_hall": Capture(
        repository="Nathan-Houel/SLAM-Drone",
        commit="6bd54a44b78226bd47608ceff2209c0fa2ebe01c",
        photos="output2/images_cropped",
        poses="output2/sparse/2",
        count=90,
        size=(648, 359),
        kind="room",
        shows="a flight hall with trusses and curtains, from a drone; noisy, some frames blurred",
    ),
    "chair": Capture(
        repository="benedictquartey/cs1430proj",
        commit="3a136d97fd2677d04bdfcecf1c23ce2e30d90cb5",
        photos="data/nerf_llff_data/dancingQ/images",
        poses="data/nerf_llff_data/dancingQ/sparse/0",
        count=68,
        size=(1080, 1920),
        kind="object in a room",
        shows="a chair with a robot's head in a laboratory, walked round; the room is seen behind",
    ),
    "figure": Capture(
        repository="Caesar-xxx/NERF",
        commit="03460c01390b65d4e8e0e9a6385ca50900f502f2",
        photos="custom_data/images",
        poses="custom_data/transforms.json",
        count=69,
        size=(2160, 3840),
        kind="object in a room",
        shows="a toy figure on a table of a flat, walked round at one height",
    ),
    "plant": Capture(
        repository="lvllvl/NeRF",
        commit="3b6aec04f821cc5686fc40174aebfed7d182fcb9",
        photos="data/raw",
        poses="data/colmap_output/transforms.json",
        count=171,
        size=(3213, 5712),
        kind="object in a room",
        shows="a potted plant on a table of a living room, from all sides and heights",
        opencv=True,
    ),
    "phone": Capture(
        repository="eunseon02/mono_slam",
        commit="1f77fbb763857b96ac9a596bc18d1e962ce18dbf",
        photos="data/images",
        poses="data/transforms.json",
        count=79,
        size=(2448, 2048),
        kind="object in a room",
        shows="a phone on a desk before a keyboard, from near; the room is seen behind",
    ),
    "can": Capture(
        repository="YhuoyuH/NeRF-Database",
        commit="83b34224ffb43e34e48db8137b3f95f8e7059cc3",
        photos="images",
        poses="sparse/0",
        count=71,
        size=(720, 1280),
        kind="outdoors",
        shows="a can on the tiles of a terrace, railings behind",
    ),
    "ray": Capture(
        repository="lywang0416/tensorf",
        commit="29e410a1033c91c2202a4eb7c6afb298ab036d3f",
        photos="data/images",
        poses="data/images/transforms.json",
        count=95,
        size=(960, 540),
        kind="object",
        shows="a plush ray on a white table, from near",
    ),
}
"""Captures by name. Photos were looked at. Poses agree with matches between neighbouring photos: in
nearly all pairs the median distance from the epipolar line is below one pixel of a picture of
800."""


def prepare(capture: Capture, clone: Path, target: Path, side: int) -> int:
    """Write pinhole photos of one size, ``transforms.json`` and seed points.

    Seed points are COLMAP's, or triangulated from keypoints of neighbouring photos.

    Args:
        capture: what to prepare.
        clone: the repository's files.
        target: the folder to write.
        side: longer side of the photos, pixels; smaller ones stay as they are.

    Returns:
        The number of photos.

    Raises:
        SceneError: if photos or poses are not there.
    """
    photos = clone / capture.photos
    poses = clone / capture.poses
    if not photos.is_dir() or not poses.exists():
        raise SceneError(
            f"{clone}: no {capture.photos} and {capture.poses}; expected "
            f"github.com/{capture.repository}"
        )
    (target / "images").mkdir(parents=True, exist_ok=True)
    content = _of_colmap(poses, target) if poses.is_dir() else _of_json(poses, capture.opencv)
    frames = sorted(content["frames"], key=lambda frame: str(frame["file_path"]))[: capture.first]
    size = None
    pictures = []
    written = []
    for frame in frames:
        path = photos / re.split(r"[\\/]", frame["file_path"])[-1]
        picture = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if picture is None:
            raise SceneError(f"{path}: found no picture; expected the photo of a pose in {poses}")
        if size is None:
            height, width = picture.shape[:2]
            scale = min(1.0, side / max(width, height))
            size = round(scale * width), round(scale * height)
        picture, K = _pinhole(picture, content | frame, size)
        cv2.imwrite(str(target / "images" / f"{path.stem}.png"), picture)
        pictures.append(picture)
        numbers = {
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            "w": size[0],
            "h": size[1],
        }
        matrix = frame["transform_matrix"]
        written.append(
            {"file_path": f"images/{path.stem}.png", "transform_matrix": matrix} | numbers
        )
    if not poses.is_dir():
        _write_points(target / "sparse_pc.ply", *seed_points(pictures, written))
    result = {"camera_model": "PINHOLE", "ply_file_path": "sparse_pc.ply", "frames": written}
    if "applied_transform" in content:
        result["applied_transform"] = content["applied_transform"]
    write_json(result, target / "transforms.json")
    return len(written)


def _of_colmap(model: Path, target: Path) -> dict[str, Any]:
    """The content of ``transforms.json`` for a COLMAP model, whose points are written to the
    target."""
    from nerfstudio.process_data.colmap_utils import colmap_to_json

    colmap_to_json(model, target)
    content: dict[str, Any] = json.loads((target / "transforms.json").read_text("utf-8"))
    return content


def _of_json(path: Path, opencv: bool) -> dict[str, Any]:
    """The content of a ``transforms.json``, with matrices of OpenGL axes."""
    content: dict[str, Any] = json.loads(path.read_text("utf-8"))
    for frame in content["frames"]:
        matrix = np.array(frame["transform_matrix"], np.float64)
        matrix[:3, 1:3] *= -1.0 if opencv else 1.0
        frame["transform_matrix"] = matrix.tolist()
    return content


def _pinhole(
    picture: NDArray[Any], camera: dict[str, Any], size: tuple[int, int]
) -> tuple[NDArray[Any], Array]:
    """A photo without distortion, of a size, and its intrinsics (3, 3) in pixels."""
    height, width = picture.shape[:2]
    w = float(camera.get("w", width))
    h = float(camera.get("h", height))
    focal = camera.get("fl_x") or 0.5 * w / np.tan(0.5 * camera["camera_angle_x"])
    K = np.array(
        [
            [focal, 0, camera.get("cx", w / 2)],
            [0, camera.get("fl_y", focal), camera.get("cy", h / 2)],
        ]
    )
    K = np.vstack([K * np.array([[size[0] / w], [size[1] / h]]), [0, 0, 1]])
    picture = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    bent = np.array([camera.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")])
    if not bent.any():
        return picture, K
    straight, _ = cv2.getOptimalNewCameraMatrix(K, bent, size, 0)  # no pixel is empty
    return cv2.undistort(picture, K, bent, None, straight), straight


def seed_points(
    pictures: list[NDArray[Any]], frames: list[dict[str, Any]]
) -> tuple[Array, NDArray[Any]]:
    """Points triangulated from matches between each photo and the next ones.

    Args:
        pictures: (H, W, 3) uint8 in BGR order, in the order of the walk.
        frames: of ``transforms.json``, pinhole.

    Returns:
        Points (P, 3) in the frame of the poses, and colours (P, 3) uint8 in RGB order.
    """
    finder = cv2.SIFT_create(KEYPOINTS)
    matcher = cv2.BFMatcher()
    found = [
        finder.detectAndCompute(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), None)
        for picture in pictures
    ]
    cameras = [_camera(frame) for frame in frames]
    points = [np.zeros((0, 3))]
    colours = [np.zeros((0, 3), np.uint8)]
    for i, first in enumerate(found):
        for j in range(i + 1, min(i + 1 + REACH, len(found))):
            second = found[j]
            if first[1] is None or second[1] is None or min(len(first[0]), len(second[0])) < 2:
                continue
            pairs = matcher.knnMatch(first[1], second[1], k=2)
            best = [a for a, b in pairs if a.distance < RATIO * b.distance]
            if not best:
                continue
            at = (
                np.array([first[0][m.queryIdx].pt for m in best]),
                np.array([second[0][m.trainIdx].pt for m in best]),
            )
            world, good = _triangulated(at, (cameras[i], cameras[j]))
            points.append(world[good])
            pixels = np.floor(at[0][good]).astype(int)
            colours.append(pictures[i][pixels[:, 1], pixels[:, 0], ::-1])
    return np.concatenate(points), np.concatenate(colours)


def _camera(frame: dict[str, Any]) -> tuple[Array, Array]:
    """Intrinsics (3, 3), and world to camera (3, 4) with OpenCV axes."""
    pose = np.array(frame["transform_matrix"], np.float64)
    pose = np.vstack([pose[:3], [0, 0, 0, 1]])
    pose[:3, 1:3] *= -1
    K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1.0]])
    return K, np.linalg.inv(pose)[:3]


def _triangulated(
    at: tuple[Array, Array], cameras: tuple[tuple[Array, Array], tuple[Array, Array]]
) -> tuple[Array, NDArray[np.bool_]]:
    """Points (M, 3) of matched pixels (M, 2), and whether each lies near both pixels, before both
    cameras, under an angle that tells its depth."""
    four = cv2.triangulatePoints(*(K @ view for K, view in cameras), *(pixels.T for pixels in at))
    with np.errstate(divide="ignore", invalid="ignore"):
        world = (four[:3] / four[3]).T.astype(np.float64)
    good = np.isfinite(world).all(1)
    world[~good] = 0.0
    rays = []
    for pixels, (K, view) in zip(at, cameras, strict=True):
        seen = world @ view[:, :3].T + view[:, 3]
        depth = np.where(seen[:, 2] > 0, seen[:, 2], np.inf)
        off = (seen @ K.T)[:, :2] / depth[:, None] - pixels
        good &= (seen[:, 2] > 0) & (np.hypot(*off.T) < NEAR)
        ray = world + view[:, :3].T @ view[:, 3]
        rays.append(ray / np.linalg.norm(ray, axis=1, keepdims=True).clip(1e-12))
    return world, good & ((rays[0] * rays[1]).sum(1) < np.cos(np.radians(DEGREES)))


def _write_points(path: Path, points: Array, colours: NDArray[Any]) -> None:
    kinds = [
        *((axis, "f4") for axis in "xyz"),
        *((name, "u1") for name in ("red", "green", "blue")),
    ]
    rows = np.zeros(len(points), kinds)
    for name, column in zip(rows.dtype.names, (*points.T, *colours.T), strict=True):
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


def main(
    name: tyro.conf.Positional[str] = "",
    clone: tyro.conf.Positional[Path | None] = None,
    target: tyro.conf.Positional[Path | None] = None,
    side: int = 960,
) -> None:
    """List the captures, or make one ready to train.

    Args:
        name: of a capture; by default all are listed.
        clone: a clone of its repository.
        target: the folder to write.
        side: longer side of the photos, pixels.
    """
    if not name:
        rows = [
            (
                name,
                group_of(name),
                a.kind,
                a.count,
                f"{a.size[0]} x {a.size[1]}",
                a.licence,
                a.shows,
                a.repository,
            )
            for name, a in CAPTURES.items()
        ]
        heads = ("capture", "for", "kind", "photos", "pixels", "licence", "shows", "github.com/")
        console().print(
            table("captures", heads, rows, left=("for", "kind", "licence", "shows", "github.com/"))
        )
        return
    if name not in CAPTURES or clone is None or target is None:
        raise SceneError(
            f"capture {name!r}, clone {clone}, target {target}; expected one of {', '.join(CAPTURES)}, \
a clone of its repository, and a folder to write"
        )
    count = prepare(CAPTURES[name], clone, target, side)
    print(f"{target}: {count} photos")


if __name__ == "__main__":
    start(main)
