"""glTF with ``KHR_gaussian_splatting``, an extension that Khronos has ratified, as a binary ``.glb``: uncompressed.

Each attribute is an array of its own, sizes and opacities not as logarithms and logits. Written are float32 numbers,
and colours as bytes for programs that know only points; read are all types that the extension allows.
"""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import MAX_SH_DEGREE, PLAIN, Gaussians, Offset, Traits
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.io.files import logger, require_file, require_memory
from pointsplat_ns.io.formats.coding import (
    PACKED,
    Array,
    bytes_of_logits,
    damage_named,
    finite_sizes,
    joined,
    load_bytes,
    log_of_sizes,
    scene_of,
    shares_of_dc,
    to_bytes,
    unit_quats,
)
from pointsplat_ns.io.formats.holding import FLOAT_SIZES, Holds, Span
from pointsplat_ns.io.formats.spz import decode_spz
from pointsplat_ns.io.offsets import SAMPLED, offset_for
from pointsplat_ns.io.turning import Similarity
from pointsplat_ns.io.usable import keep_usable
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.tensors import DOUBLES

JSON_BYTES = 8192
"""The description is filled up with spaces to this size, so that a file's size follows from the number of Gaussians."""

HOLDS = Holds(sizes=FLOAT_SIZES, opacities=Span(0.0, 1.0), antialiased=False, offset=True)

_EXTENSION = "KHR_gaussian_splatting"
_SPZ = "KHR_gaussian_splatting_compression_spz"
"""Inside :data:`_EXTENSION`, mostly with a version: ``_2``."""
_OLD_SPZ = "KHR_spz_gaussian_splats_compression"
"""As CesiumJS drew it in 2025, in place of :data:`_EXTENSION`."""


def read_glb(path: Path | str) -> Gaussians:
    """Read all Gaussians of a ``.glb``, as :func:`~pointsplat_ns.io.read_scene` does, where its nodes place them; also
    those that it holds as SPZ, with the axes that they have there. Nodes that skew or scale unevenly are not applied,
    which is logged. Raises SceneError if there are no Gaussians, they are compressed otherwise or lie in other files,
    or the file is damaged."""
    path = require_file(path, "a .glb file")
    with damage_named(path, "glTF"):
        content, binary = _chunks(load_bytes(path), path)
        meshes: dict[int, Gaussians] = {}
        count = 0
        for index, mesh in enumerate(content.get("meshes", [])):
            found = [one for one in mesh["primitives"] if {_EXTENSION, _OLD_SPZ} & one.get("extensions", {}).keys()]
            if found:
                parts = []
                for primitive in found:
                    parts.append(_primitive(primitive, content, binary, path))
                    count += len(parts[-1])
                    if 17 * count > max(1 << 22, PACKED * len(binary)):  # of primitives that share their numbers
                        raise SceneError(f"{path}: {count} Gaussians and more; {len(binary)} bytes cannot hold them")
                meshes[index] = joined(parts)
        if not meshes:
            raise SceneError(f"{path}: no Gaussians; expected a glTF with {_EXTENSION}")
        placed = [(meshes[index], matrix) for index, matrix in _shown(content) if index in meshes]
        if len(placed) > 10_000:
            raise SceneError(f"{path}: {len(placed)} nodes with Gaussians; expected at most 10000")
        require_memory(path, 4 * sum(len(mesh) * (11 + 3 * (mesh.sh_degree + 1) ** 2) for mesh, _ in placed))
        offset = _offset_of(*placed[0]) if placed else None
        moved = [_moved(mesh, _translated(matrix, offset), path) for mesh, matrix in placed]
        scene = joined(moved or [*meshes.values()])
    return keep_usable(scene.replace(offset=offset), path)


def _offset_of(mesh: Gaussians, matrix: Array) -> Offset | None:
    """The translation of a node, if float32 would round the positions of its Gaussians too far there; else None."""
    x, y, z = matrix[:3, 3].tolist()
    some = mesh[:: max(1, len(mesh) // SAMPLED)]
    if not (x or y or z):
        return None
    linear = matrix[:3, :3]
    size = math.log(max(abs(float(np.linalg.det(linear))), 1e-300)) / 3
    means = some.means.double().numpy() @ linear.T + matrix[:3, 3]
    return None if offset_for(means, some.scales.double().numpy() + size) is None else (x, y, z)


def _translated(matrix: Array, offset: Offset | None) -> Array:
    """A node's matrix (4, 4) to the world about an offset."""
    if offset is None:
        return matrix
    moved = matrix.copy()
    moved[:3, 3] -= offset
    return moved


def _shown(content: dict[str, Any]) -> list[tuple[int, Array]]:
    """The meshes that nodes of the scene have, by index, each with the matrix (4, 4) float64 from it to the world."""
    nodes, found, seen = content.get("nodes", []), [], set()
    if content.get("scenes"):
        roots = _entry(content["scenes"], content.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [index for index in range(len(nodes)) if index not in children]
    waiting = [(root, np.eye(4)) for root in roots]
    while waiting:
        index, above = waiting.pop()
        node = _entry(nodes, index)
        if index in seen:
            raise ValueError(f"node {index} has two parents")
        seen.add(index)
        matrix = above @ _matrix(node)
        if "mesh" in node:
            found.append((node["mesh"], matrix))
        waiting += [(child, matrix) for child in node.get("children", [])]
    return found[::-1]


def _matrix(node: dict[str, Any]) -> Array:
    """The matrix (4, 4) float64 of a node."""
    if "matrix" in node:
        matrix = np.asarray(node["matrix"], np.float64).reshape(4, 4).T  # a file has columns
    else:
        matrix = np.eye(4)
        x, y, z, w = node.get("rotation", (0, 0, 0, 1))
        turn = rotation_matrices(torch.tensor([[w, x, y, z]], **DOUBLES))[0].numpy()
        matrix[:3, :3] = turn * np.asarray(node.get("scale", (1, 1, 1)), np.float64).reshape(3)
        matrix[:3, 3] = np.asarray(node.get("translation", (0, 0, 0)), np.float64).reshape(3)
    if not np.isfinite(matrix).all():
        raise ValueError("a node's transform is not finite")
    return matrix


def _moved(scene: Gaussians, matrix: Array, path: Path) -> Gaussians:
    """A scene where a node places it."""
    if np.array_equal(matrix, np.eye(4)):
        return scene
    linear = torch.from_numpy(matrix[:3, :3].copy())
    scale = float(torch.linalg.det(linear).abs()) ** (1 / 3)
    turn = linear / scale if scale > 0 else linear
    if not torch.allclose(turn @ turn.T, torch.eye(3, **DOUBLES), atol=1e-4):
        logger.warning("%s: a node that skews or scales unevenly is not applied", path)
        return scene
    return Similarity(turn, scale, torch.from_numpy(matrix[:3, 3].copy())).apply(scene)


def _chunks(data: bytes, path: Path) -> tuple[dict[str, Any], memoryview]:
    """The description and the binary chunk of a ``.glb``."""
    if data[:4] != b"glTF" or len(data) < 20 or struct.unpack_from("<I", data, 4) != (2,):
        raise SceneError(f"{path}: not a .glb file of version 2 (starts with {data[:8]!r})")
    size, kind = struct.unpack_from("<I4s", data, 12)
    if kind != b"JSON" or 20 + size > len(data):
        raise SceneError(f"{path}: truncated; a description of {size} bytes is expected at byte 20")
    content = json.loads(data[20 : 20 + size])
    if not isinstance(content, dict):
        raise ValueError("its description is no object")
    if 28 + size > len(data):
        return content, memoryview(b"")
    length, kind = struct.unpack_from("<I4s", data, 20 + size)
    if kind != b"BIN\0" or 28 + size + length > len(data):
        raise SceneError(
            f"{path}: truncated; {length} bytes expected at byte {28 + size}, found {len(data) - 28 - size}"
        )
    return content, memoryview(data)[28 + size : 28 + size + length]


def _primitive(primitive: dict[str, Any], content: dict[str, Any], binary: memoryview, path: Path) -> Gaussians:
    """The Gaussians of one primitive, by the accessors of its attributes."""
    about = primitive["extensions"].get(_EXTENSION, {})
    inner = about.get("extensions", {})
    packed = primitive["extensions"].get(_OLD_SPZ) or next(
        (value for name, value in inner.items() if name.startswith(_SPZ)), None
    )
    if packed is not None:
        return decode_spz(bytes(_view(packed["bufferView"], content, binary, path)), path)
    attributes, others = primitive["attributes"], [*inner]
    if others or about.get("kernel", "ellipse") != "ellipse":
        wanted = ", ".join([*others, f"the kernel {about.get('kernel')}"])
        raise SceneError(f"{path}: its Gaussians need {wanted}; expected {_EXTENSION} alone, of ellipses")
    if about.get("colorSpace", "srgb_rec709_display") != "srgb_rec709_display":
        logger.warning("%s: colours of the space %s are read as sRGB", path, about["colorSpace"])

    def values(name: str, columns: int) -> Array:
        return _numbers(attributes[name], columns, content, binary, path)

    degree = max(d for d in range(MAX_SH_DEGREE + 1) if d == 0 or f"{_EXTENSION}:SH_DEGREE_{d}_COEF_0" in attributes)
    means = values("POSITION", 3)
    require_memory(path, 8 * len(means) * (11 + 3 * (degree + 1) ** 2))
    alphas = values(f"{_EXTENSION}:OPACITY", 1).clip(0, 1)
    with np.errstate(divide="ignore"):
        logits = np.log(alphas) - np.log1p(-alphas)
    coefficients = [
        values(f"{_EXTENSION}:SH_DEGREE_{d}_COEF_{index}", 3) for d in range(degree + 1) for index in range(2 * d + 1)
    ]
    if {len(array) for array in coefficients} != {len(means)}:
        raise ValueError("attributes of different lengths")
    return scene_of(
        means,
        log_of_sizes(values(f"{_EXTENSION}:SCALE", 3)),
        values(f"{_EXTENSION}:ROTATION", 4)[:, [3, 0, 1, 2]],
        logits,
        coefficients[0],
        np.stack(coefficients[1:], axis=1) if degree else np.empty((len(means), 0, 3)),
    )


def _numbers(index: int, columns: int, content: dict[str, Any], binary: memoryview, path: Path) -> Array:
    """The values (N, columns) of an accessor, float64."""
    accessor = _entry(content["accessors"], index)
    if "sparse" in accessor or "bufferView" not in accessor:
        raise SceneError(f"{path}: a sparse accessor; expected its numbers in the file's binary chunk")
    view = _entry(content["bufferViews"], accessor["bufferView"])
    part = _view(accessor["bufferView"], content, binary, path)
    types = {5120: np.int8, 5121: np.uint8, 5122: np.int16, 5123: np.uint16, 5126: np.float32}
    dtype = np.dtype(types[accessor["componentType"]]).newbyteorder("<")
    if {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]] != columns:
        raise ValueError(f"an accessor of {accessor['type']}, expected {columns} numbers each")
    count, row = accessor["count"], columns * dtype.itemsize
    stride = view.get("byteStride", row)
    within = accessor.get("byteOffset", 0)
    sizes = (count, stride, within)
    if not all(isinstance(size, int) and size >= 0 for size in sizes) or stride < row:
        raise ValueError(f"sizes {sizes} of an accessor")
    needed = within + stride * (count - 1) + row if count else 0
    if needed > len(part):
        raise SceneError(f"{path}: truncated; an accessor of {count} entries reaches beyond its {len(part)} bytes")
    array = np.ndarray((count, columns), dtype, part, within, (stride, dtype.itemsize))
    values = array.astype(np.float64)
    if accessor.get("normalized") and dtype.kind in "iu":
        values = (values / np.iinfo(dtype).max).clip(-1)
    return values


def _view(index: int, content: dict[str, Any], binary: memoryview, path: Path) -> memoryview:
    """The bytes of a buffer view."""
    view = _entry(content["bufferViews"], index)
    if view["buffer"] != 0 or "uri" in content["buffers"][0]:
        raise SceneError(f"{path}: its numbers lie in another file; expected them in its binary chunk")
    begin, length = view.get("byteOffset", 0), view["byteLength"]
    if not all(isinstance(size, int) and size >= 0 for size in (begin, length)):
        raise ValueError(f"sizes {begin}, {length} of a buffer view")
    if begin + length > len(binary):
        raise SceneError(f"{path}: truncated; {length} bytes expected at byte {begin} of {len(binary)}")
    return binary[begin : begin + length]


def _entry(entries: Any, index: Any) -> dict[str, Any]:
    if not isinstance(index, int) or not 0 <= index < len(entries):
        raise ValueError(f"entry {index!r} of {len(entries)}")
    return entries[index]


def glb_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> int:
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
        "nodes": [{"mesh": 0} if scene.offset is None else {"mesh": 0, "translation": list(scene.offset)}],
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
