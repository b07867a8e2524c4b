"""Scenes in the Replica layout: photos and depth images of a plane, by cameras that face +z."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from PIL import Image

CAMERA = {"w": 8, "h": 6, "fx": 5.0, "fy": 5.0, "cx": 3.5, "cy": 2.5, "scale": 1000.0}


def line_of(pose: np.ndarray) -> str:
    """A matrix (4, 4) as a line of ``traj.txt``."""
    return " ".join(map(str, pose.reshape(-1).tolist()))


def write_frames(
    scene: Path, photos: Iterable[np.ndarray], places: np.ndarray, depth: int | None
) -> Path:
    """Write photos (H, W, 3), taken from places (N, 3), and images of one depth, if it is not
    None."""
    (scene / "results").mkdir(parents=True)
    for n, photo in enumerate(photos):
        Image.fromarray(photo).save(scene / "results" / f"frame{n:06d}.png")
        if depth is not None:
            Image.fromarray(np.full(photo.shape[:2], depth, np.uint16)).save(
                scene / "results" / f"depth{n:06d}.png"
            )
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    (scene / "traj.txt").write_text("\n".join(map(line_of, poses)) + "\n")
    return scene


def write_scene(
    folder: Path, frames: int = 4, step: float = 0.1, depth: bool = True, camera: dict = CAMERA
) -> Path:
    """Frames of 8 x 6 pixels, whose red is ten times their number, ``step`` apart along x, 2 units
    from the plane."""
    places = step * np.arange(frames)[:, None] * [1.0, 0.0, 0.0]
    photos = (np.full((6, 8, 3), (10 * n, 50, 200), np.uint8) for n in range(frames))
    write_frames(folder, photos, places, 2000 if depth else None)
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera}))
    return folder
