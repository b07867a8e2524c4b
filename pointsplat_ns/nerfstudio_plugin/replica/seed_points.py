"""Seed points: depth images fused into one point cloud, spread evenly over the surfaces."""

import numpy as np

from pointsplat_ns.errors import DataError
from pointsplat_ns.nerfstudio_plugin.replica.layout import ReplicaScene, read_depth, read_photo
from pointsplat_ns.system.progress import tracked


def fuse_depth(
    scene: ReplicaScene,
    num_points: int,
    principal_point: tuple[float, float],
    progress: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Unproject the depth images of training frames and thin them to at most ``num_points`` points: xyz float32 (P, 3)
    in scene units and rgb uint8 (P, 3). Deterministic; P = 0 if no pixel has a depth.

    At most 200 frames are read, evenly spaced, one at a time: neighbouring frames of a video see the same surfaces. At
    most ``40 * num_points`` pixels are kept in total, several for most voxels, so that time and memory do not grow with
    the length of the capture. Each occupied voxel gives one point, the mean of its pixels. The voxels are as small as
    ``num_points`` allows. ``principal_point`` is (cx, cy) with the first pixel's centre at 0.5. Raises DataError if the
    scene has no depth images.
    """
    depths = scene.depths
    if depths is None:
        raise DataError(f"{scene.folder}: no depth images; expected one for every photo")
    chosen = np.unique(np.linspace(0, len(scene) - 1, min(len(scene), 200)).round().astype(int))
    params = scene.params
    budget = max(num_points * 40 // len(chosen), 1)
    step = max(int(np.ceil(np.sqrt(params.width * params.height / budget))), 1)
    all_xyz, all_rgb = [], []
    shown = progress and len(chosen) >= 20  # fewer take about a second
    for order, index in enumerate(tracked(chosen, "Seed points from depth", len(chosen), shown)):
        depth = read_depth(depths[index], params)
        valid = _inner(depth)
        # The offset of the sampling grid moves through the step x step cell from frame to frame; step + 1 is coprime
        # to step * step, so that it visits every place.
        offset = (order * (step + 1)) % (step * step)
        v, u = np.mgrid[offset // step : params.height : step, offset % step : params.width : step]
        v, u = v[valid[v, u]], u[valid[v, u]]
        z = depth[v, u].astype(np.float64)
        camera = np.stack(
            [
                (u + 0.5 - principal_point[0]) / params.fx * z,
                (v + 0.5 - principal_point[1]) / params.fy * z,
                z,
            ],
            axis=-1,
        )
        pose = scene.poses[index]
        all_xyz.append((camera @ pose[:3, :3].T + pose[:3, 3]).astype(np.float32))
        all_rgb.append(read_photo(scene.photos[index], params)[v, u])
    return voxel_thin(np.concatenate(all_xyz), np.concatenate(all_rgb), num_points)


def voxel_thin(xyz: np.ndarray, rgb: np.ndarray, num_points: int) -> tuple[np.ndarray, np.ndarray]:
    """Points xyz float32 (M, 3) and rgb uint8 (M, 3), averaged over voxels of the smallest size that leaves at most
    ``num_points`` of them, in the order of the voxels; the input itself if it is small enough."""
    if len(xyz) <= num_points:
        return xyz, rgb
    low = xyz.min(axis=0).astype(np.float64)
    extent = max(float((xyz.max(axis=0) - low).max()), 1e-12)
    finest, coarsest = extent / 2**20, extent * 1.001  # 20 bits an axis fit an int64 key
    keys = _voxel_keys(xyz, low, coarsest)
    # The number of occupied voxels falls with their size: bisect the size on a log scale, to 1 %.
    while coarsest / finest > 1.01:
        size = float(np.sqrt(finest * coarsest))
        trial = _voxel_keys(xyz, low, size)
        if len(np.unique(trial)) > num_points:
            finest = size
        else:
            coarsest, keys = size, trial
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    inverse = inverse.reshape(-1)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(inverse, weights=values[:, i], minlength=len(counts)) for i in range(3)]
        return np.stack(sums, axis=-1) / counts[:, None]

    points = (mean(xyz.astype(np.float64) - low) + low).astype(np.float32)
    return points, np.clip(mean(rgb).round(), 0, 255).astype(np.uint8)


def _voxel_keys(xyz: np.ndarray, low: np.ndarray, size: float) -> np.ndarray:
    cell = np.floor((xyz - low) / size).astype(np.int64)
    return (cell[:, 0] << 42) | (cell[:, 1] << 21) | cell[:, 2]


def _inner(depth: np.ndarray, edge: float = 0.05) -> np.ndarray:
    """bool (H, W): depth is measured here and in the four neighbours, and differs from theirs by a share of at most
    ``edge``. Others are taken to lie on an outline, where sensors and resampling produce points between two surfaces:
    on a plane, depth changes this much from one pixel to the next only at grazing angles (over 85 degrees)."""
    measured = depth > 0
    inner = measured.copy()
    for axis in (0, 1):
        before = [slice(None), slice(None)]
        after = [slice(None), slice(None)]
        before[axis], after[axis] = slice(None, -1), slice(1, None)
        a, b = depth[tuple(before)], depth[tuple(after)]
        joined = (a > 0) & (b > 0) & (np.abs(a - b) <= edge * np.minimum(a, b))
        inner[tuple(before)] &= joined
        inner[tuple(after)] &= joined
    return inner
