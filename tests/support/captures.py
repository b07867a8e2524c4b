"""One tiny painted room, photographed exactly through any lens, in the layouts that nerfstudio's
dataparsers read."""

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from plys import write_columns
from scipy.spatial.transform import Rotation

from posing import write_colmap

WIDTH = 64
HEIGHT = 48
FRAMES = 10
OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
SEEDS = 300
HELD_OUT = (2, 5, 8)
BAD = (3, 8)
"""Frames of ScanNet++'s test split, and those that it marks as bad."""


@dataclass(frozen=True)
class Lens:
    """Intrinsics in pixels, as nerfstudio counts them (the first pixel's centre is 0.5), and
    distortion.

    ``model`` is OPENCV (``distortion`` k1, k2, p1, p2) or OPENCV_FISHEYE (k1 to k4).
    """

    model: str = "OPENCV"
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    focal: tuple[float, float] = (45.0, 46.0)
    center: tuple[float, float] = (31.0, 24.5)

    @property
    def coefficients(self) -> dict[str, float]:
        """By nerfstudio's names."""
        names = (
            ("k1", "k2", "k3", "k4") if self.model == "OPENCV_FISHEYE" else ("k1", "k2", "p1", "p2")
        )
        return dict(zip(names, self.distortion, strict=True))

    @property
    def transforms(self) -> dict[str, object]:
        """The keys of a ``transforms.json``."""
        size = {"w": WIDTH, "h": HEIGHT, "fl_x": self.focal[0], "fl_y": self.focal[1]}
        return {
            "camera_model": self.model,
            **size,
            "cx": self.center[0],
            "cy": self.center[1],
            **self.coefficients,
        }

    def directions(self) -> np.ndarray:
        """Where the centres of pixels look, (H, W, 3), in OpenCV axes; found by OpenCV's own
        inverse."""
        u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
        pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
        K = np.array(
            [[self.focal[0], 0, self.center[0]], [0, self.focal[1], self.center[1]], [0, 0, 1.0]]
        )
        undistort = (
            cv2.fisheye.undistortPoints if self.model == "OPENCV_FISHEYE" else cv2.undistortPoints
        )
        plane = undistort(pixels, K, np.array(self.distortion)).reshape(HEIGHT, WIDTH, 2)
        return np.concatenate([plane, np.ones((HEIGHT, WIDTH, 1))], axis=-1)


def colors_at(points: np.ndarray) -> np.ndarray:
    """Colours (..., 3) in [0, 1] of the walls at points (..., 3)."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = [np.sin(1.7 * x + y + 1), np.cos(1.9 * y - z), np.sin(2.1 * z + x - y)]
    return np.stack([0.5 + 0.4 * wave for wave in waves], axis=-1)


def seen_from(eye: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Where rays (..., 3) from within the room meet its walls, (..., 3)."""
    half_size = np.array([1.6, 1.3, 1.0])  # of the room, about the origin; z is up
    with np.errstate(divide="ignore"):
        lengths = (np.sign(directions) * half_size - eye) / directions
    return eye + directions * lengths.min(axis=-1, keepdims=True)


class Capture:
    """Photos of the room by one lens. Poses (N, 4, 4) are camera-to-world in OpenGL axes, as
    nerfstudio's."""

    def __init__(self, lens: Lens | None = None):
        self.lens = lens or Lens()
        rng = np.random.default_rng(11)
        turns = np.linspace(0, 2 * math.pi, FRAMES, endpoint=False)
        self.poses = np.tile(np.eye(4), (FRAMES, 1, 1))
        for pose, turn in zip(self.poses, turns, strict=True):
            # Look about the room, tilted and rolled a little; the camera looks along -z.
            pose[:3, :3] = Rotation.from_euler(
                "zxz", [turn, 1.4 + 0.3 * rng.random(), 0.2 * rng.random()]
            ).as_matrix()
            pose[:3, 3] = rng.uniform(-0.4, 0.4, 3)
        self.seeds = seen_from(np.zeros(3), rng.normal(size=(SEEDS, 3)))
        self.seed_colors = np.round(255 * colors_at(self.seeds)).astype(np.uint8)

    @cached_property
    def photos(self) -> list[np.ndarray]:
        """(H, W, 3), uint8, RGB."""
        rays = self.lens.directions()
        turned = [rays @ (pose @ OPENCV_TO_OPENGL)[:3, :3].T for pose in self.poses]
        walls = [seen_from(pose[:3, 3], ray) for pose, ray in zip(self.poses, turned, strict=True)]
        return [np.round(255 * colors_at(wall)).astype(np.uint8) for wall in walls]

    def write_photos(self, folder: Path, suffix: str = ".png", first: int = 0) -> list[str]:
        """Write all photos; their names."""
        folder.mkdir(parents=True)
        names = [f"{number:05d}{suffix}" for number in range(first, first + FRAMES)]
        for name, photo in zip(names, self.photos, strict=True):
            cv2.imwrite(str(folder / name), photo[..., ::-1])
        return names

    def write_nerfstudio(self, folder: Path) -> Path:
        """What ``ns-process-data images`` makes: transforms.json, photos and a PLY of points."""
        names = self.write_photos(folder / "images")
        frames = [
            {"file_path": f"images/{name}", "transform_matrix": pose.tolist()}
            for name, pose in zip(names, self.poses, strict=True)
        ]
        meta = {**self.lens.transforms, "ply_file_path": "points.ply", "frames": frames}
        (folder / "transforms.json").write_text(json.dumps(meta))
        columns = dict(zip("xyz", self.seeds.T.astype(np.float32), strict=True))
        columns |= dict(zip(("red", "green", "blue"), self.seed_colors.T, strict=True))
        write_columns(folder / "points.ply", columns, text=True)
        return folder

    def write_colmap(
        self, model: Path, names: list[str], move: np.ndarray | None = None, suffix: str = ".txt"
    ) -> None:
        """COLMAP's files of the poses and seeds, moved by a rigid matrix (4, 4)."""
        move = np.eye(4) if move is None else move
        lens = (
            self.lens.model,
            WIDTH,
            HEIGHT,
            [*self.lens.focal, *self.lens.center, *self.lens.distortion],
        )
        viewmats = np.linalg.inv(move @ self.poses @ OPENCV_TO_OPENGL)
        seeds = self.seeds @ move[:3, :3].T + move[:3, 3]
        write_colmap(
            model, suffix, lens, dict(zip(names, viewmats, strict=True)), seeds, self.seed_colors
        )

    def write_scannetpp(self, folder: Path) -> Path:
        """ScanNet++'s dslr/ folder: masks over what is not to be seen, one bad frame in each split,
        COLMAP's model in a frame of its own."""
        names = self.write_photos(folder / "dslr/resized_images")
        (folder / "dslr/resized_anon_masks").mkdir()
        mask = np.full((HEIGHT, WIDTH), 255, np.uint8)
        mask[30:42, 10:26] = 0  # where the photos are spoilt
        frames = []
        for number, (name, pose) in enumerate(zip(names, self.poses, strict=True)):
            photo = folder / "dslr/resized_images" / name
            cv2.imwrite(
                str(photo),
                np.where(mask[..., None] > 0, cv2.imread(str(photo)), np.uint8([255, 0, 255])),
            )
            cv2.imwrite(str(folder / "dslr/resized_anon_masks" / name), mask)
            frame = {"file_path": name, "mask_path": name, "transform_matrix": pose.tolist()}
            frames.append({**frame, "is_bad": number in BAD})
        test = [frames[number] for number in HELD_OUT]
        meta = {**self.lens.transforms, "has_mask": True, "test_frames": test}
        meta["frames"] = [frame for frame in frames if frame not in test]
        (folder / "dslr/nerfstudio").mkdir()
        (folder / "dslr/nerfstudio/transforms.json").write_text(json.dumps(meta))
        moved = np.eye(4)
        moved[:3] = np.c_[
            Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), [3.0, -2.0, 0.5]
        ]
        self.write_colmap(folder / "dslr/colmap", names, moved)
        return folder
