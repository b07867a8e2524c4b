"""Writes rooms as data sets, like captures of real rooms along a walk."""

from __future__ import annotations

import json
import math
import os
import shutil
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from lab.rooms.render import default_intrinsics, render_room
from lab.rooms.room import Room, make_room
from pointsplat_ns.errors import DataError
from pointsplat_ns.system.files import read_text
from pointsplat_ns.system.progress import Progress, tracked


def is_written(folder: Path, frames: int, width: int, height: int) -> bool:
    """Whether a folder holds a room of such photos. As rooms get their names when they are
    complete, it then is."""
    try:
        camera = json.loads(read_text(folder / "cam_params.json"))["camera"]
        poses = read_text(folder / "traj.txt").splitlines()
        photos = list((folder / "results").glob("frame*.jpg"))
        return len(poses) == len(photos) == frames and (camera["w"], camera["h"]) == (width, height)
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        return False


def write_room(
    folder: Path,
    seed: int,
    frames: int = 80,
    width: int = 320,
    height: int = 240,
    progress: bool | Progress = True,
) -> Path:
    """Write photos, depth images and poses of a room in the Replica layout, atomically.

    Args:
        folder: the scene folder to create, with its parents.
        seed: seed of the room.
        frames: number of photos, at least 2.
        width: width of a photo, pixels, at least 8.
        height: height of a photo, pixels, at least 8.
        progress: True shows a bar; a function is called with the name of the task and the share of
            it that is done.

    Returns:
        ``folder``.

    Raises:
        DataError: if ``folder`` exists and is not an empty folder or cannot be written, or there
            are too few frames or pixels.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     scene = write_room(Path(folder) / "room3", seed=3, frames=2, width=32, height=24, progress=False)
        ...     sorted(path.name for path in scene.iterdir())
        ['cam_params.json', 'results', 'traj.txt']
    """
    from PIL import Image

    folder = Path(folder)
    if frames < 2 or width < 8 or height < 8:
        raise DataError(
            f"room of {frames} frames, {width} x {height}: expected at least 2 frames of 8 x 8 "
            "pixels"
        )
    partial = folder.with_name(f".{folder.name[:50]}.partial-{os.getpid()}")
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise DataError(
                f"{folder}: exists and is not an empty folder; remove it or name another"
            )
        (partial / "results").mkdir(parents=True)
        room = make_room(seed)
        poses = capture_path(room, frames, seed)
        K = default_intrinsics(width, height)
        counts = 6553.5  # of depth a metre, as in Replica's files: 10 m fill 16 bits
        for number in tracked(range(frames), f"Room {seed}", frames, progress):
            rgb, depth = render_room(room, poses[number], K, width, height)
            pixels = (rgb * 255).round().to(torch.uint8).numpy()
            raw = (depth * counts).round().clamp(0, 65534).numpy().astype(np.uint16)
            # Without chroma subsampling: coloured edges stay sharp.
            Image.fromarray(pixels).save(
                partial / "results" / f"frame{number:06d}.jpg", quality=97, subsampling=0
            )
            Image.fromarray(raw).save(
                partial / "results" / f"depth{number:06d}.png", compress_level=1
            )
        lines = [" ".join(f"{v:.9g}" for v in pose.double().reshape(-1).tolist()) for pose in poses]
        (partial / "traj.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
        # Replica's files count from the first pixel's centre, hence the half pixel less.
        camera = {
            "w": width,
            "h": height,
            "fx": float(K[0, 0]),
            "fy": float(K[1, 1]),
            "cx": width / 2 - 0.5,
            "cy": height / 2 - 0.5,
            "scale": counts,
        }
        (partial / "cam_params.json").write_text(
            json.dumps({"camera": camera}, indent=1) + "\n", encoding="utf-8"
        )
        os.replace(partial, folder)
    except OSError as error:
        raise DataError(f"{folder}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder


def capture_path(room: Room, frames: int, seed: int) -> Tensor:
    """Camera poses (F, 4, 4) on a walk of two rounds through a room: the first looks across it, the
    second to both sides. float32, camera-to-world, OpenCV axes, z of the world up, metres.

    Height and pitch vary on the way; the seed decides where the walk starts, which way it goes, and
    how they vary. Positions keep at least 0.3 m from all surfaces: 1.05 m from walls, which is more
    than furniture as high as the camera is deep, and above all that stands in the middle.

    Example:
        >>> from lab.rooms import make_room
        >>> tuple(capture_path(make_room(seed=3), frames=5, seed=3).shape)
        (5, 4, 4)
    """
    rng = np.random.default_rng([seed, 21])
    share = np.linspace(0, 1, frames, endpoint=False)
    turn = 1.0 if rng.random() < 0.5 else -1.0
    start, height_phase, pitch_phase = rng.random(3)
    angle = 2 * math.pi * (start + turn * 2 * share)
    second = np.clip((share - 0.4) / 0.2, 0, 1)
    second = second * second * (3 - 2 * second)
    # The second round is narrower, and the camera swings to both sides, to see into the corners.
    reach = (np.array(room.size[:2]) / 2 - 1.05)[:, None] * (1 - 0.35 * second)
    x, y = reach * [np.cos(angle), np.sin(angle)]
    top = min(1.7, room.size[2] - 0.8)
    z = (1.3 + top) / 2 + (top - 1.3) / 2 * np.sin(2 * math.pi * (3 * share + height_phase))
    yaw = angle + math.pi + (0.2 + 0.7 * second) * np.sin(2 * math.pi * 3 * share)
    pitch = -0.22 + 0.24 * np.sin(2 * math.pi * (5 * share + pitch_phase))
    return torch.from_numpy(_looking(np.stack([x, y, z], 1), yaw, pitch)).float()


def _looking(positions: np.ndarray, yaw: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Camera-to-world (F, 4, 4), OpenCV axes, level horizon."""
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], 1)
    right = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], 1)
    poses = np.tile(np.eye(4), (len(yaw), 1, 1))
    poses[:, :3] = np.stack([right, np.cross(forward, right), forward, positions], 2)
    return poses
