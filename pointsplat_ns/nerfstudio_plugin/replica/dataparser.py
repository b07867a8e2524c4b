"""nerfstudio dataparser for the Replica layouts of NICE-SLAM and of Semantic-NeRF
(``replica-data``)."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import (
    DataParser,
    DataParserConfig,
    DataparserOutputs,
)
from nerfstudio.data.scene_box import SceneBox

from pointsplat_ns.errors import DataError
from pointsplat_ns.geometry.transforms import flip_camera_axes
from pointsplat_ns.nerfstudio_plugin.console import log
from pointsplat_ns.nerfstudio_plugin.replica.layout import (
    ReplicaScene,
    load_replica,
    read_depth,
    read_photo,
)
from pointsplat_ns.system.progress import tracked


@dataclass
class ReplicaDataParserConfig(DataParserConfig):
    """Posed photos, with or without depth images, in NICE-SLAM's or Semantic-NeRF's Replica
    layout"""

    _target: type = field(default_factory=lambda: ReplicaDataParser)
    data: Path = Path("data/replica/office0")
    """Scene folder, with traj.txt and results/ (cam_params.json in it or in the folder above), or a
    sequence with traj_w_c.txt and rgb/."""
    frame_stride: int = 1
    """Use every n-th frame, in the order of their numbers."""
    eval_every: int = 10
    """Hold out every n-th of the used frames for evaluation, the first one included."""
    load_seed_points: bool = True
    """Fuse the depth images of the training frames into points from which Splatfacto starts."""
    num_seed_points: int = 50_000
    """Number of seed points at most."""


@dataclass
class ReplicaDataParser(DataParser):
    """Reads a scene of the Replica layout; no orientation, centring or automatic scaling is
    applied."""

    config: ReplicaDataParserConfig
    _scene: ReplicaScene | None = None

    def _generate_dataparser_outputs(self, split: str = "train", **kwargs) -> DataparserOutputs:
        """See the base class. ``split`` is "train", or "val" or "test", which are the same held-out
        frames. Raises DataError if the folder or the configuration cannot be used."""
        config = self.config
        for name, least in {"frame_stride": 1, "eval_every": 2, "num_seed_points": 1}.items():
            if (value := getattr(config, name)) < least:
                raise DataError(
                    f"--{name.replace('_', '-')} {value}: expected a number of at least {least}"
                )
        self._scene = scene = self._scene or load_replica(config.data)  # once for both splits
        used = range(0, len(scene), config.frame_stride)
        held_out = list(used[:: config.eval_every])
        train = sorted(set(used) - set(held_out))
        if not train or not held_out:
            raise DataError(
                f"{scene.folder}: {len(scene)} usable frames leave {len(train)} for training and "
                f"{len(held_out)} "
                "held out; expected at least one of each: change --frame-stride or --eval-every"
            )
        part = scene.select(train if split == "train" else held_out)
        params = scene.params
        (cx, cy) = scene.params.principal_point
        camera_to_worlds = flip_camera_axes(torch.from_numpy(part.poses))[
            :, :3
        ]  # OpenCV to nerfstudio's OpenGL
        cameras = Cameras(
            camera_to_worlds.float(),
            params.fx,
            params.fy,
            cx,
            cy,
            params.width,
            params.height,
            camera_type=CameraType.PERSPECTIVE,
        )
        metadata: dict[str, torch.Tensor] = {}
        if split == "train" and config.load_seed_points:
            xyz, rgb = fuse_depth(part, config.num_seed_points)
            if len(xyz) > 0:
                metadata = {
                    "points3D_xyz": torch.from_numpy(xyz),
                    "points3D_rgb": torch.from_numpy(rgb),
                }
            else:
                log(
                    f"{scene.folder}: photos without depth images, or no known pixel in these: no "
                    "seed points"
                )
        centers = scene.poses[:, :3, 3]
        low = centers.min(axis=0)
        high = centers.max(axis=0)
        margin = max(
            float(np.linalg.norm(high - low)), 1.0
        )  # around all cameras: their distance, or one unit
        box = torch.from_numpy(np.stack([low - margin, high + margin]).astype(np.float32))
        return DataparserOutputs(
            list(part.photos), cameras, scene_box=SceneBox(aabb=box), metadata=metadata
        )


def fuse_depth(scene: ReplicaScene, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Unproject the depth images of a scene and thin them to at most ``num_points`` points: xyz
    float32 (P, 3) in scene units and rgb uint8 (P, 3). Deterministic; P = 0 without depth images,
    or if no pixel has a depth.

    At most 200 frames are read, evenly spaced, and ``40 * num_points`` pixels, so that time and
    memory do not grow with the length of the capture. Each occupied voxel, as small as
    ``num_points`` allows, gives the mean of its pixels.
    """
    depths = scene.depths
    params = scene.params
    if depths is None:
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8)
    cx, cy = params.principal_point
    chosen = np.unique(np.linspace(0, len(scene) - 1, min(len(scene), 200)).round().astype(int))
    budget = max(num_points * 40 // len(chosen), 1)
    step = max(int(np.ceil(np.sqrt(params.width * params.height / budget))), 1)
    all_xyz = []
    all_rgb = []
    shown = len(chosen) >= 20  # fewer take about a second
    for order, index in enumerate(tracked(chosen, "Seed points from depth", len(chosen), shown)):
        depth = read_depth(depths[index], params)
        valid = _inner(depth)
        # The offset of the sampling grid moves through the step x step cell from frame to frame;
        # step + 1 is coprime to step * step, so that it visits every place.
        offset = (order * (step + 1)) % (step * step)
        v, u = np.mgrid[offset // step : params.height : step, offset % step : params.width : step]
        v, u = v[valid[v, u]], u[valid[v, u]]
        z = depth[v, u].astype(np.float64)
        camera = np.stack(
            [(u + 0.5 - cx) / params.fx * z, (v + 0.5 - cy) / params.fy * z, z], axis=-1
        )
        pose = scene.poses[index]
        all_xyz.append((camera @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
        all_rgb.append(read_photo(scene.photos[index], params)[v, u])
    return voxel_thin(np.concatenate(all_xyz), np.concatenate(all_rgb), num_points)


def voxel_thin(xyz: np.ndarray, rgb: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Points xyz float32 (M, 3) and rgb uint8 (M, 3), averaged over voxels of the smallest size
    that leaves at most ``num_points`` of them, in the order of the voxels; the input itself if it
    is small enough."""
    if len(xyz) <= num_points:
        return xyz, rgb
    low = xyz.min(axis=0).astype(np.float64)
    extent = max(float((xyz.max(axis=0) - low).max()), 1e-12)
    # 20 bits an axis fit an int64 key
    finest = extent / 2**20
    coarsest = extent * 1.001

    def voxels(size: float) -> np.ndarray:
        cell = np.floor((xyz - low) / size).astype(np.int64)
        return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]

    keys = voxels(coarsest)
    # The number of occupied voxels falls with their size: bisect the size on a log scale, to 1 %.
    while coarsest / finest > 1.01:
        size = float(np.sqrt(finest * coarsest))
        trial = voxels(size)
        if len(np.unique(trial)) > num_points:
            finest = size
        else:
            coarsest = size
            keys = trial
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(inverse, weights=values[:, i], minlength=len(counts)) for i in range(3)]
        return np.stack(sums, axis=-1) / counts[:, None]

    points = (mean(xyz.astype(np.float64) - low) + low).astype(np.float32)
    return points, np.clip(mean(rgb).round(), 0, 255).astype(np.uint8)


def _inner(depth: np.ndarray, edge: float = 0.05) -> np.ndarray:
    """bool (H, W): depth is measured here and in the four neighbours, and differs from theirs by a
    share of at most ``edge``. Others are taken to lie on an outline, where sensors and resampling
    produce points between two surfaces: on a plane, depth changes this much from one pixel to the
    next only at grazing angles (over 85 degrees)."""
    inner = depth > 0
    for axis in (0, 1):
        along = np.moveaxis(depth, axis, 0)
        kept = np.moveaxis(inner, axis, 0)
        a = along[:-1]
        b = along[1:]
        joined = (a > 0) & (b > 0) & (np.abs(a - b) <= edge * np.minimum(a, b))
        kept[:-1] &= joined
        kept[1:] &= joined
    return inner
