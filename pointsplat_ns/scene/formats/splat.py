"""``.splat`` files: 32 bytes a Gaussian, no header, introduced by antimatter15's viewer.

A row is position and standard deviations as float32, then colour, opacity and quaternion wxyz as
bytes. The SH degree is 0.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.formats import coding
from pointsplat_ns.scene.formats.capacity import Capacity, Span
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.files import require_file, require_memory
from pointsplat_ns.system.opening import open_regular
from pointsplat_ns.system.progress import Progress, silent

_ROW = np.dtype([("means", "<f4", 3), ("stds", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])

CAPACITY = Capacity(
    colours=Span(-0.5 / SH_C0, 0.5 / SH_C0, 1 / (255 * SH_C0)), sh=None, antialiased=False
)


def read_splat(path: Path | str) -> Gaussians:
    """Read a ``.splat`` file, as :func:`~pointsplat_ns.scene.read_scene` does; the SH degree is 0.
    Raises SceneError if its size is not a multiple of 32 bytes, it is text, or it does not fit into
    memory."""
    path = require_file(path, "a .splat file")
    with coding.damage_named(path, ".splat"), open_regular(path) as stream:
        size = os.fstat(stream.fileno()).st_size
        start = stream.read(4096)
    if size % _ROW.itemsize:
        raise SceneError(f"{path}: {size} bytes; expected {_ROW.itemsize} bytes a Gaussian")
    if (
        start
        and start.isascii()
        and start.decode().replace("\n", "").replace("\r", "").replace("\t", "").isprintable()
    ):
        raise SceneError(f"{path}: text ({start[:24]!r}...); expected the rows of a .splat file")
    require_memory(path, size + size // _ROW.itemsize * 4 * 14)
    with coding.damage_named(path, ".splat"):
        with open_regular(path) as stream:
            rows = np.fromfile(stream, _ROW)
        # zero gives -Inf, a flat axis; a negative size gives NaN, which is dropped
        return coding.scene_of(
            rows["means"],
            np.log(rows["stds"]),
            (rows["quats"].astype(np.float32) - 128) / 128,
            coding.logits_of_bytes(rows["rgba"][:, 3]),
            (rows["rgba"][:, :3].astype(np.float32) / 255 - 0.5) / SH_C0,
            np.empty((len(rows), 0, 3)),
        )


def drawing_order(scene: Gaussians) -> Tensor:
    """Indices (N,), largest and most opaque Gaussians first, because viewers draw while loading."""
    weight = scene.scales.double().clamp(-20, 20).sum(dim=1).exp() * scene.alphas
    return weight.argsort(descending=True, stable=True)


def encode_splat(scene: Gaussians, progress: Progress = silent) -> bytes:
    """Encode a scene, float32 on the CPU, as a ``.splat`` file, in :func:`drawing_order`.

    Drops SH above degree 0, for which the format has no place. ``progress`` is not called.
    """
    scene = scene[drawing_order(scene)]
    rows = np.empty(len(scene), _ROW)
    rows["means"] = scene.means.numpy()
    # Readers drop infinite sizes.
    rows["stds"] = scene.stds.clamp_max(torch.finfo(torch.float32).max).numpy()
    rows["rgba"][:, :3] = coding.to_bytes(255 * coding.shares_of_dc(scene))
    rows["rgba"][:, 3] = coding.bytes_of_logits(scene)
    rows["quats"] = coding.to_bytes(128 * coding.unit_quats(scene) + 128)
    return rows.tobytes()
