"""glTF with ``KHR_gaussian_splatting``, as a binary ``.glb``: uncompressed, written only.

Each attribute is a float32 array of its own, sizes and opacities not as logarithms and logits. The extension is a
review draft of Khronos. Colours as bytes are added for programs that know only points.
"""

from __future__ import annotations

import json
import struct

import numpy as np

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats.coding import Array, bytes_of_logits, finite_sizes, shares_of_dc, to_bytes, unit_quats
from pointsplat_ns.system.progress import Progress, silent

JSON_BYTES = 8192
"""The description is filled up with spaces to this size, so that a file's size follows from the number of Gaussians."""

_EXTENSION = "KHR_gaussian_splatting"


def glb_bytes(count: int, sh_degree: int) -> int:
    """Size of a ``.glb`` of ``count`` Gaussians, bytes."""
    floats = 3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2
    return 12 + 8 + JSON_BYTES + 8 + (4 * floats + 4) * count


def encode_glb(scene: Gaussians, progress: Progress = silent) -> bytes:
    """The bytes of a ``.glb`` with one mesh of points, of a scene, float32 on the CPU. The axes stay those of the
    scene; glTF's own have y up. ``progress`` is not called."""
    arrays = _attributes(scene)
    as_float, as_byte, array_buffer, points = 5126, 5121, 34962, 0  # glTF's numbers
    views: list[dict[str, object]] = []
    accessors: list[dict[str, object]] = []
    offset = 0
    for name, array in arrays.items():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": array_buffer})
        accessor = {
            "bufferView": len(accessors),
            "componentType": as_byte if array.dtype == np.uint8 else as_float,
            "count": len(array),
            "type": {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[array.shape[1]],
        }
        if array.dtype == np.uint8:
            accessor["normalized"] = True
        if name == "POSITION" and len(array):
            accessor.update(min=array.min(axis=0).tolist(), max=array.max(axis=0).tolist())
        accessors.append(accessor)
        offset += array.nbytes
    ellipse = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    primitive = {
        "attributes": {name: index for index, name in enumerate(arrays)},
        "mode": points,
        "extensions": {_EXTENSION: ellipse},
    }
    content = {
        "asset": {"version": "2.0", "generator": "pointsplat-ns"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": offset}],
    }
    text = json.dumps(content, separators=(",", ":")).encode().ljust(JSON_BYTES)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + offset)
    parts = [head, struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", offset, b"BIN\0")]
    return b"".join([*parts, *(array.tobytes() for array in arrays.values())])


def _attributes(scene: Gaussians) -> dict[str, Array]:
    """The arrays of the file by their attribute's name, each (N, 1), (N, 3) or (N, 4)."""
    rgba = np.column_stack([to_bytes(255 * shares_of_dc(scene)), bytes_of_logits(scene)])
    arrays: dict[str, Array] = {"POSITION": scene.means.numpy(), "COLOR_0": rgba}
    of_splats: dict[str, Array] = {
        "ROTATION": unit_quats(scene)[:, [1, 2, 3, 0]],
        "SCALE": finite_sizes(scene),
        "OPACITY": scene.alphas[:, None].numpy(),
    }
    coefficients = scene.sh.numpy()
    for degree in range(scene.sh_degree + 1):
        for index in range(2 * degree + 1):
            of_splats[f"SH_DEGREE_{degree}_COEF_{index}"] = coefficients[:, degree**2 + index]
    arrays.update({f"{_EXTENSION}:{name}": array.astype("<f4") for name, array in of_splats.items()})
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}
