"""Writes rooms as data sets, like captures of real rooms."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import torch

from pointsplat_ns.errors import DataError
from pointsplat_ns.io.files import lack_of_room, read_text
from pointsplat_ns.rooms.camera_path import capture_path
from pointsplat_ns.rooms.render import default_intrinsics, render_room
from pointsplat_ns.rooms.room import make_room
from pointsplat_ns.system.progress import Progress, tracked


def is_written(folder: Path, frames: int, width: int, height: int) -> bool:
    """Whether a folder holds a room of such photos. As rooms get their names when they are complete, it then is."""
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
        progress: True shows a bar; a function is called with the name of the task and the share of it that is done.

    Returns:
        ``folder``.

    Raises:
        DataError: if ``folder`` exists and is not an empty folder or cannot be written, or there are too few frames or
            pixels.

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
        raise DataError(f"room of {frames} frames, {width} x {height}: expected at least 2 frames of 8 x 8 pixels")
    partial = folder.with_name(f".{folder.name[:50]}.partial-{os.getpid()}")
    try:
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            raise DataError(f"{folder}: exists and is not an empty folder; remove it or name another")
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
            Image.fromarray(pixels).save(partial / "results" / f"frame{number:06d}.jpg", quality=97, subsampling=0)
            Image.fromarray(raw).save(partial / "results" / f"depth{number:06d}.png", compress_level=1)
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
        (partial / "cam_params.json").write_text(json.dumps({"camera": camera}, indent=1) + "\n", encoding="utf-8")
        os.replace(partial, folder)
    except OSError as error:
        why = f"{error.strerror or error}{lack_of_room(error, partial)}"
        raise DataError(f"{folder}: cannot be written ({why})") from error
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return folder
