"""Tiny scenes in the Replica layout."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

CAMERA = {"w": 8, "h": 6, "fx": 5.0, "fy": 5.0, "cx": 3.5, "cy": 2.5, "scale": 1000.0}


def write_scene(
    folder: Path, frames: int = 4, step: float = 0.1, depth: bool = True, camera: dict | None = None
) -> Path:
    """Write frames of 8 x 6 pixels, whose red is ten times their number, and give the folder.

    The cameras stand in a row along x, ``step`` apart, face +z and are 2 units from a plane.
    """
    (folder / "results").mkdir(parents=True)
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = step * np.arange(frames)
    for n in range(frames):
        Image.new("RGB", (8, 6), (10 * n, 50, 200)).save(folder / "results" / f"frame{n:06d}.png")
        if depth:
            Image.fromarray(np.full((6, 8), 2000, np.uint16)).save(folder / "results" / f"depth{n:06d}.png")
    (folder / "traj.txt").write_text("\n".join(map(line_of, poses)) + "\n")
    (folder / "cam_params.json").write_text(json.dumps({"camera": camera or CAMERA}))
    return folder


def line_of(pose: np.ndarray) -> str:
    """A matrix (4, 4) as a line of ``traj.txt``."""
    return " ".join(map(str, pose.reshape(-1).tolist()))
