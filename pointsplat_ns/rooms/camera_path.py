"""Camera paths through a room, as of a person with a camera: clear of furniture, and with all of the room in view."""

import math

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.rooms.room import Room


def capture_path(room: Room, frames: int, seed: int) -> Tensor:
    """Camera poses (F, 4, 4) on a walk of two rounds through a room: the first looks across it, the second to both
    sides. float32, camera-to-world, OpenCV axes, z of the world up, metres.

    Height and pitch vary on the way; the seed decides where the walk starts, which way it goes, and how they vary.
    Positions keep at least 0.3 m from all surfaces: 1.05 m from walls, which is more than furniture as high as the
    camera is deep, and above all that stands in the middle.

    Example:
        >>> from pointsplat_ns.rooms import make_room
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
