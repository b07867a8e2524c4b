"""glTF with ``KHR_gaussian_splatting``, an extension that Khronos has ratified, as a binary ``.glb``: uncompressed.

Each attribute is an array of its own, sizes and opacities not as logarithms and logits; all types that the extension
allows are read. :mod:`~pointsplat_ns.io.formats.glb_writing` writes such files.
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
from pointsplat_ns.gaussians import MAX_SH_DEGREE, Gaussians, Offset
from pointsplat_ns.geometry.transforms import rotation_matrices
from pointsplat_ns.io.files import logger, require_file, require_memory
from pointsplat_ns.io.formats.coding import (
    PACKED,
    Array,
    damage_named,
    joined,
    load_bytes,
    log_of_sizes,
    scene_of,
)
from pointsplat_ns.io.formats.glb_writing import GAUSSIANS
from pointsplat_ns.io.formats.spz import decode_spz
from pointsplat_ns.io.offsets import SAMPLED, offset_for
from pointsplat_ns.io.turning import Similarity
from pointsplat_ns.io.usable import keep_usable
from pointsplat_ns.system.tensors import DOUBLES

_SPZ = "KHR_gaussian_splatting_compression_spz"
"""Inside :data:`GAUSSIANS`, mostly with a version: ``_2``."""
_OLD_SPZ = "KHR_spz_gaussian_splats_compression"
"""As CesiumJS drew it in 2025, in place of :data:`GAUSSIANS`."""


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
            found = [one for one in mesh["primitives"] if {GAUSSIANS, _OLD_SPZ} & one.get("extensions", {}).keys()]
            if found:
                parts = []
                for primitive in found:
                    parts.append(_primitive(primitive, content, binary, path))
                    count += len(parts[-1])
                    if 17 * count > max(1 << 22, PACKED * len(binary)):  # of primitives that share their numbers
                        raise SceneError(f"{path}: {count} Gaussians and more; {len(binary)} bytes cannot hold them")
                meshes[index] = joined(parts)
        if not meshes:
            raise SceneError(f"{path}: no Gaussians; expected a glTF with {GAUSSIANS}")
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
    about = primitive["extensions"].get(GAUSSIANS, {})
    inner = about.get("extensions", {})
    packed = primitive["extensions"].get(_OLD_SPZ) or next(
        (value for name, value in inner.items() if name.startswith(_SPZ)), None
    )
    if packed is not None:
        return decode_spz(bytes(_view(packed["bufferView"], content, binary, path)), path)
    attributes, others = primitive["attributes"], [*inner]
    if others or about.get("kernel", "ellipse") != "ellipse":
        wanted = ", ".join([*others, f"the kernel {about.get('kernel')}"])
        raise SceneError(f"{path}: its Gaussians need {wanted}; expected {GAUSSIANS} alone, of ellipses")
    if about.get("colorSpace", "srgb_rec709_display") != "srgb_rec709_display":
        logger.warning("%s: colours of the space %s are read as sRGB", path, about["colorSpace"])

    def values(name: str, columns: int) -> Array:
        return _numbers(attributes[name], columns, content, binary, path)

    degree = max(d for d in range(MAX_SH_DEGREE + 1) if d == 0 or f"{GAUSSIANS}:SH_DEGREE_{d}_COEF_0" in attributes)
    means = values("POSITION", 3)
    require_memory(path, 8 * len(means) * (11 + 3 * (degree + 1) ** 2))
    alphas = values(f"{GAUSSIANS}:OPACITY", 1).clip(0, 1)
    with np.errstate(divide="ignore"):
        logits = np.log(alphas) - np.log1p(-alphas)
    coefficients = [
        values(f"{GAUSSIANS}:SH_DEGREE_{d}_COEF_{index}", 3) for d in range(degree + 1) for index in range(2 * d + 1)
    ]
    if {len(array) for array in coefficients} != {len(means)}:
        raise ValueError("attributes of different lengths")
    return scene_of(
        means,
        log_of_sizes(values(f"{GAUSSIANS}:SCALE", 3)),
        values(f"{GAUSSIANS}:ROTATION", 4)[:, [3, 0, 1, 2]],
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
