"""Compressed PLYs as PlayCanvas writes them, which are read and not written."""

import numpy as np

from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.formats.coding import smallest_three, unit_quats
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply_header import first_lines


def _packed(shares: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Words (N,) of shares in [0, 1], (N, 3), the first in the upper bits."""
    words = np.zeros(len(shares), np.uint32)
    for column, n in zip(shares.T, bits, strict=True):
        words = words << n | np.rint(column.astype(float) * ((1 << n) - 1)).astype(np.uint32)
    return words


def encode_compressed_ply(scene: Gaussians) -> bytes:
    """The bytes of a file of a scene, its Gaussians in order: 256 share bounds."""
    n = len(scene)
    starts = np.arange(0, len(scene), 256)
    of = np.arange(len(scene)) // 256
    bounds = []
    shares = []
    for part in (scene.means, scene.scales.clamp(-20, 20), 0.5 + SH_C0 * scene.features_dc):
        low, high = (end.reduceat(part.numpy(), starts) for end in (np.minimum, np.maximum))
        bounds += [low, high]
        shares.append(((part.numpy() - low[of]) / (high - low)[of].clip(1e-9)).clip(0, 1))
    largest, others = smallest_three(unit_quats(scene))
    rotation = largest.astype(np.uint32) << 30 | _packed(
        (others / 2**0.5 + 0.5).clip(0, 1), (10, 10, 10)
    )
    color = _packed(shares[2], (8, 8, 8)) << 8 | np.rint(
        255 * scene.alphas.double().numpy()
    ).astype(np.uint32)
    words = (_packed(shares[0], (11, 10, 11)), rotation, _packed(shares[1], (11, 10, 11)), color)
    rest = scene.features_rest.transpose(1, 2).flatten(1).double().numpy()
    sh = np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)  # of [-4, 4]
    parts = ("x y z", "scale_x scale_y scale_z", "r g b")
    names = [f"{end}_{name}" for part in parts for end in ("min", "max") for name in part.split()]
    lines = [
        *first_lines(scene.traits),
        f"element chunk {len(starts)}",
        *(f"property float {name}" for name in names),
    ]
    lines += [f"element vertex {n}"]
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if rest.shape[1]:
        lines += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(rest.shape[1]))]
    data = (np.concatenate(bounds, axis=1).astype("<f4"), np.stack(words, axis=1).astype("<u4"), sh)
    return "\n".join([*lines, "end_header", ""]).encode() + b"".join(
        part.tobytes() for part in data
    )
