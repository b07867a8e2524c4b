"""Writes glTF with ``KHR_gaussian_splatting`` as ``.glb``: float32 numbers, and colours as bytes for programs that know
only points; or the Gaussians as SPZ inside, for tiles (:func:`encode_tile`)."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from typing import Any

import numpy as np

from pointsplat_ns.gaussians import PLAIN, Gaussians, Traits
from pointsplat_ns.io.formats.coding import (
    Array,
    bytes_of_logits,
    finite_sizes,
    shares_of_dc,
    to_bytes,
    unit_quats,
)
from pointsplat_ns.io.formats.holding import FLOAT_SIZES, Holds, Span
from pointsplat_ns.io.formats.spz import encode_spz
from pointsplat_ns.system.progress import Progress, silent

GAUSSIANS = "KHR_gaussian_splatting"
TILE_EXTENSIONS = (GAUSSIANS, "KHR_gaussian_splatting_compression_spz_2")
"""What a program must know to draw tiles."""

HOLDS = Holds(sizes=FLOAT_SIZES, opacities=Span(0.0, 1.0), antialiased=False, offset=True)

_JSON_BYTES = 8192
"""The description is filled up with spaces to this size, so that a file's size follows from the number of Gaussians."""
_FLOAT, _BYTE, _ARRAY_BUFFER = 5126, 5121, 34962  # glTF's numbers


def glb_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> int:
    """Size of a ``.glb`` of ``count`` Gaussians, bytes."""
    floats = 3 + 4 + 3 + 1 + 3 * (sh_degree + 1) ** 2
    return 12 + 8 + _JSON_BYTES + 8 + (4 * floats + 4) * count


def encode_glb(scene: Gaussians, progress: Progress = silent) -> bytes:
    """The bytes of a ``.glb`` with one mesh of points, of a scene, float32 on the CPU. The axes stay those of the
    scene; glTF's own have y up. ``progress`` is not called."""
    arrays = _attributes(scene)
    views: list[dict[str, Any]] = []
    offset = 0
    for array in arrays.values():
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": _ARRAY_BUFFER})
        offset += array.nbytes
    ellipse = {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "sortingMethod": "cameraDistance",
        "projection": "perspective",
    }
    node = {} if scene.offset is None else {"translation": list(scene.offset)}
    content = _content(scene, [*arrays], {"extensionsUsed": [GAUSSIANS]}, ellipse, node, views)
    return _packed(content, _JSON_BYTES, [array.tobytes() for array in arrays.values()])


def encode_tile(scene: Gaussians, progress: Progress = silent) -> bytes:
    """The bytes of a ``.glb`` with the Gaussians of a scene, float32 on the CPU, as SPZ, as CesiumJS wants them.

    The scene has z up, as tiles have. Its node turns it to y up, as glTF has, and moves it to its offset. The axes in
    the SPZ are the scene's.
    """
    packed = encode_spz(scene.replace(offset=None), progress)
    bands = [f"SH_DEGREE_{d}_COEF_{index}" for d in range(1, scene.sh_degree + 1) for index in range(2 * d + 1)]
    names = ["POSITION", "COLOR_0", *(f"{GAUSSIANS}:{name}" for name in ("SCALE", "ROTATION", *bands))]
    spz = {"extensions": {TILE_EXTENSIONS[1]: {"bufferView": 0}}}
    x, y, z = scene.offset or (0.0, 0.0, 0.0)
    node = {"matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, x, z, -y, 1]}  # columns
    view = {"buffer": 0, "byteOffset": 0, "byteLength": len(packed)}
    needed = {"extensionsUsed": TILE_EXTENSIONS, "extensionsRequired": TILE_EXTENSIONS}
    return _packed(_content(scene, names, needed, spz, node, [view]), 0, [packed])


def _content(
    scene: Gaussians,
    names: Sequence[str],
    needed: dict[str, Any],
    about: dict[str, Any],
    node: dict[str, Any],
    views: list[dict[str, Any]],
) -> dict[str, Any]:
    """The description of a file with one mesh: the names of its attributes, what programs need, and what it says of its
    Gaussians, of their node, and of its bytes, a view for each attribute or one for all."""
    shapes = {"COLOR_0": "VEC4", f"{GAUSSIANS}:ROTATION": "VEC4", f"{GAUSSIANS}:OPACITY": "SCALAR"}
    accessors: list[dict[str, Any]] = []
    for index, name in enumerate(names):
        accessors.append({"bufferView": index} if len(views) == len(names) else {})
        as_type = _BYTE if name == "COLOR_0" else _FLOAT
        accessors[-1].update(componentType=as_type, count=len(scene), type=shapes.get(name, "VEC3"))
    accessors[names.index("COLOR_0")]["normalized"] = True
    if len(scene):
        low, high = scene.means.aminmax(dim=0)
        accessors[names.index("POSITION")].update(min=low.tolist(), max=high.tolist())
    attributes = {name: index for index, name in enumerate(names)}
    return {
        "asset": {"version": "2.0", "generator": "pointsplat-ns"},
        **needed,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, **node}],
        "meshes": [{"primitives": [{"attributes": attributes, "mode": 0, "extensions": {GAUSSIANS: about}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": sum(view["byteLength"] for view in views)}],
    }


def _packed(content: dict[str, Any], least: int, parts: Sequence[bytes]) -> bytes:
    """A file with a description of at least so many bytes, and a binary chunk."""
    text = json.dumps(content, separators=(",", ":")).encode()
    text = text.ljust(max(least, len(text) + -len(text) % 4))
    size = sum(map(len, parts))
    pad = bytes(-size % 4)
    head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + size + len(pad))
    chunks = [struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", size + len(pad), b"BIN\0")]
    return b"".join([head, *chunks, *parts, pad])


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
    arrays.update({f"{GAUSSIANS}:{name}": array.astype("<f4") for name, array in of_splats.items()})
    return {name: np.ascontiguousarray(array) for name, array in arrays.items()}
