"""Shared test data: a tiny scene whose every pixel is known."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
WALL_DISTANCE = 2.0
DEPTH_SCALE = 6553.5
NUM_FRAMES = 11


def wall_colors(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Colours (..., 3) in [0, 1] of the wall at x, y in scene units."""
    return np.stack(
        [0.5 + 0.4 * np.sin(4 * x), 0.5 + 0.4 * np.cos(5 * y), 0.5 + 0.4 * np.sin(3 * x + 2 * y)],
        axis=-1,
    )


def write_wall(scene: Path, num_frames: int = NUM_FRAMES, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """Write exact photos, depth images and poses of a painted wall, in the Replica layout.

    The cameras stand ``WALL_DISTANCE`` before the wall z = 0, look along +z and step sideways.

    Returns:
        ``scene``.
    """
    (scene / "results").mkdir(parents=True)
    cx, cy = (width - 1) / 2, (height - 1) / 2
    camera = {"w": width, "h": height, "fx": FOCAL, "fy": FOCAL, "cx": cx, "cy": cy, "scale": DEPTH_SCALE}
    (scene.parent / "cam_params.json").write_text(json.dumps({"camera": camera}))
    u, v = np.meshgrid(np.arange(width), np.arange(height))
    poses = []
    for i in range(num_frames):
        x, y = 0.6 * np.cos(i), 0.4 * np.sin(2 * i)
        colors = wall_colors(x + (u - cx) / FOCAL * WALL_DISTANCE, y + (v - cy) / FOCAL * WALL_DISTANCE)
        photo = np.round(255 * colors).astype(np.uint8)
        cv2.imwrite(str(scene / "results" / f"frame{i:06d}.png"), photo[..., ::-1])
        depth = np.full((height, width), round(WALL_DISTANCE * DEPTH_SCALE), dtype=np.uint16)
        cv2.imwrite(str(scene / "results" / f"depth{i:06d}.png"), depth)
        pose = np.eye(4)
        pose[:3, 3] = x, y, -WALL_DISTANCE
        poses.append(" ".join(f"{value:.9g}" for value in pose.reshape(-1)))
    (scene / "traj.txt").write_text("\n".join(poses) + "\n")
    return scene


@pytest.fixture(scope="session")
def wall_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the painted wall; shared by all tests, so do not write to it."""
    return write_wall(tmp_path_factory.mktemp("replica") / "wall")
