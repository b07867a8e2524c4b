"""Writes 3D Tiles content: ``.glb`` with Gaussians as SPZ inside (``KHR_gaussian_splatting``)."""

from __future__ import annotations

import json
import struct
from typing import Any

from pointsplat_ns.scene.formats.spz import encode_spz
from pointsplat_ns.scene.gaussians import Gaussians

TILE_EXTENSIONS = ("KHR_gaussian_splatting", "KHR_gaussian_splatting_compression_spz_2")
"""glTF extensions that a viewer must support to draw tiles."""


def encode_tile(scene: Gaussians) -> bytes:
    """Encode the N > 0 Gaussians of a scene, float32 on the CPU, as a ``.glb`` for CesiumJS.

    The scene is z-up, as 3D Tiles are. Its node rotates it to glTF's y-up and moves it to its
    offset. The SPZ keeps the scene's axes.
    """
    packed = encode_spz(scene.replace(offset=None))
    (prefix, packing) = TILE_EXTENSIONS
    bands = [
        f"SH_DEGREE_{d}_COEF_{index}"
        for d in range(1, scene.sh_degree + 1)
        for index in range(2 * d + 1)
    ]
    names = ["POSITION", "COLOR_0", *(f"{prefix}:{name}" for name in ("SCALE", "ROTATION", *bands))]
    shapes = {"COLOR_0": "VEC4", f"{prefix}:ROTATION": "VEC4"}
    accessors: list[dict[str, Any]] = [
        {"componentType": 5126, "count": len(scene), "type": shapes.get(name, "VEC3")}
        for name in names
    ]
    accessors[1].update(componentType=5121, normalized=True)  # bytes; the others are float32
    low, high = scene.means.aminmax(dim=0)
    accessors[0].update(min=low.tolist(), max=high.tolist())
    x, y, z = scene.offset or (0.0, 0.0, 0.0)
    primitive = {
        "attributes": {name: index for index, name in enumerate(names)},
        "mode": 0,
        "extensions": {prefix: {"extensions": {packing: {"bufferView": 0}}}},
    }
    # columns
    content = {
        "asset": {"version": "2.0", "generator": "pointsplat-ns"},
        "extensionsUsed": TILE_EXTENSIONS,
        "extensionsRequired": TILE_EXTENSIONS,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, x, z, -y, 1]}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": len(packed)}],
        "buffers": [{"byteLength": len(packed)}],
    }
    text = json.dumps(content, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    pad = bytes(-len(packed) % 4)
    head = struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(packed) + len(pad))
    chunks = [
        struct.pack("<I4s", len(text), b"JSON"),
        text,
        struct.pack("<I4s", len(packed) + len(pad), b"BIN\0"),
    ]
    return b"".join([head, *chunks, packed, pad])
