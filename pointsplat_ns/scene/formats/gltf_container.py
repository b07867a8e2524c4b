"""glTF 2.0 as a container: a description in JSON, and binary data that its accessors lay out.

A ``.glb`` holds both. The buffers of a ``.gltf`` are base64 in its text, or files beside it.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import unquote

import numpy as np

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.formats.coding import Array, file_beside, load_bytes
from pointsplat_ns.system.files import failure_named, require_memory
from pointsplat_ns.system.opening import open_regular

MAGIC = b"glTF"

_CHUNK = struct.Struct("<I4s")
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_INDICES = (5121, 5123, 5125)
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


@dataclass(frozen=True, eq=False)
class Container:
    """A glTF file that is read: its description, and its binary data on demand. Methods raise
    ValueError or SceneError for damaged content."""

    path: Path
    content: dict[str, Any]
    binary: tuple[int, int] | None = None
    """Start and size of the binary chunk of a ``.glb``."""
    _buffers: dict[int, memoryview] = field(default_factory=dict)

    @classmethod
    def open(cls, path: Path) -> Container:
        """Read the description of a ``.glb`` or ``.gltf``, told apart by content."""
        with open_regular(path) as stream:
            found = _chunks(stream, path) if stream.read(4) == MAGIC else None
        binary = None
        if found is None:
            text = load_bytes(path)
        else:
            (start, size), binary = found
            text = bytes(_bytes_at(path, start, size))
        content = json.loads(text.decode("utf-8-sig"))
        if not isinstance(content, dict) or not isinstance(content.get("asset"), dict):
            raise SceneError(f"{path}: not a glTF file; its description names no asset")
        if not str(content["asset"].get("version", "")).startswith("2"):
            version = content["asset"].get("version")
            raise SceneError(f"{path}: glTF of version {version!r}; expected 2.0")
        return cls(path, content, binary)

    def items(self, kind: str) -> list[Any]:
        """All objects of a kind, such as "nodes"."""
        return listed(self.content, kind)

    def item(self, kind: str, index: Any) -> dict[str, Any]:
        """One object of a kind, by its index."""
        items = self.items(kind)
        if not _is_whole(index) or index >= len(items) or not isinstance(items[index], dict):
            raise ValueError(f"{kind} {index!r} is missing")
        return items[index]

    def buffer_files(self) -> list[Path]:
        """The files beside a ``.gltf`` that hold its buffers."""
        uris = [buffer.get("uri") for buffer in self.items("buffers") if isinstance(buffer, dict)]
        return [
            file_beside(self.path, unquoted(uri))
            for uri in uris
            if uri is not None and not str(uri).startswith("data:")
        ]

    def view(self, index: Any) -> memoryview:
        """The bytes of a buffer view."""
        about = self.item("bufferViews", index)
        for name in mapping(about, "extensions"):
            if name.endswith("_meshopt_compression"):
                raise SceneError(
                    f"{self.path}: compressed with {name}, which is not read; export it without"
                )
        data = self._buffer(about["buffer"])
        start = whole(about, "byteOffset", 0)
        size = whole(about, "byteLength")
        if start + size > len(data):
            raise SceneError(
                f"{self.path}: truncated; buffer view {index} ends at byte {start + size}, its "
                f"buffer has {len(data)}"
            )
        return data[start : start + size]

    def count(self, index: Any) -> int:
        """Number of elements of an accessor, at least 1."""
        return whole(self.item("accessors", index), "count", least=1)

    def stored_count(self, index: Any) -> int:
        """The same for an accessor that must have all its elements in a buffer view."""
        about = self.item("accessors", index)
        if "bufferView" not in about:
            raise ValueError(f"accessor {index} has no data")
        count = self.count(index)
        self._strided(about, _component(about["componentType"]), count, 1)
        return count

    def accessor(self, index: Any, kind: str) -> Array:
        """The elements (N, C) of an accessor of a type such as "VEC3", float32. Integers that are
        normalized become -1 to 1, or 0 to 1."""
        about = self.item("accessors", index)
        if about.get("type") != kind:
            raise ValueError(f"accessor {index} is of type {about.get('type')!r}, expected {kind}")
        count = self.count(index)
        width = _WIDTHS[kind]
        dtype = _component(about["componentType"])
        if "bufferView" in about:
            values = self._strided(about, dtype, count, width)
        elif "sparse" in about or not mapping(about, "extensions"):
            require_memory(self.path, 8 * count * width)
            values = np.zeros((count, width), dtype)
        else:
            names = ", ".join(about["extensions"])
            raise SceneError(f"{self.path}: accessors of {names} are not read; export without")
        if sparse := mapping(about, "sparse"):
            values = self._overlaid(values, sparse)
        return _as_floats(values, bool(about.get("normalized")))

    def _strided(self, about: dict[str, Any], dtype: np.dtype, count: int, width: int) -> Array:
        """Elements of a buffer view, which may lie apart from one another."""
        data = self.view(about["bufferView"])
        size = width * dtype.itemsize
        stride = whole(self.item("bufferViews", about["bufferView"]), "byteStride", size)
        start = whole(about, "byteOffset", 0)
        if stride < size:
            raise ValueError(f"a stride of {stride} bytes for elements of {size}")
        end = start + (count - 1) * stride + size
        if end > len(data):
            raise SceneError(
                f"{self.path}: truncated; an accessor of {count} elements ends at byte {end}, its "
                f"buffer view has {len(data)}"
            )
        return np.ndarray((count, width), dtype, data, start, (stride, dtype.itemsize))

    def _overlaid(self, values: Array, sparse: dict[str, Any]) -> Array:
        """Elements of which some are replaced."""
        count = whole(sparse, "count", least=1)
        indices = mapping(sparse, "indices")
        if indices.get("componentType") not in _INDICES:
            raise ValueError(f"sparse indices of type {indices.get('componentType')!r}")
        rows = self._strided(indices, _component(indices["componentType"]), count, 1)[:, 0]
        if int(rows.max()) >= len(values):
            raise ValueError(f"sparse index {int(rows.max())} of {len(values)} elements")
        replaced = values.copy()
        replaced[rows] = self._strided(
            mapping(sparse, "values"), values.dtype, count, values.shape[1]
        )
        return replaced

    def _buffer(self, index: Any) -> memoryview:
        if index not in self._buffers:
            about = self.item("buffers", index)
            size = whole(about, "byteLength")
            data = self._buffer_bytes(about.get("uri"), index, size)
            if len(data) < size:
                raise SceneError(
                    f"{self.path}: truncated; buffer {index} has {len(data)} bytes, expected {size}"
                )
            self._buffers[index] = data[:size]
        return self._buffers[index]

    def _buffer_bytes(self, uri: Any, index: int, size: int) -> memoryview:
        if uri is None:
            if self.binary is None or index != 0:
                raise ValueError(f"buffer {index} has no data")
            return _bytes_at(self.path, *self.binary)
        if str(uri).startswith("data:"):
            head, comma, text = str(uri).partition(",")
            if not comma or not head.endswith(";base64"):
                raise ValueError(f"buffer {index} is a data URI that is not base64")
            try:
                return memoryview(base64.b64decode(text, validate=True))
            except binascii.Error as error:
                raise ValueError(f"buffer {index}: {error}") from error
        return _bytes_at(file_beside(self.path, unquoted(uri)), 0, size)


def unquoted(uri: Any) -> Any:
    """A URI without percent signs."""
    return unquote(uri) if isinstance(uri, str) else uri


def listed(content: Any, key: str) -> list[Any]:
    """A list in a description, empty if it is absent. Raises ValueError for anything else."""
    if not isinstance(content, dict):
        raise ValueError(f"{str(content)[:60]}, expected an object")
    items = content.get(key, [])
    if not isinstance(items, list):
        raise ValueError(f"{key} is a {type(items).__name__}, expected a list")
    return items


def mapping(content: Any, key: str) -> dict[str, Any]:
    """An object in a description, empty if it is absent. Raises ValueError for anything else."""
    if not isinstance(content, dict):
        raise ValueError(f"{str(content)[:60]}, expected an object")
    found = content.get(key)
    if found is not None and not isinstance(found, dict):
        raise ValueError(f"{key} is a {type(found).__name__}, expected an object")
    return found or {}


def whole(about: dict[str, Any], key: str, default: int | None = None, least: int = 0) -> int:
    """A whole number in a description, at least ``least``; KeyError or ValueError otherwise."""
    number = about[key] if default is None else about.get(key, default)
    if not _is_whole(number) or number < least:
        raise ValueError(f"{key} is {number!r}, expected a whole number from {least} on")
    return number


def numbers(values: Any, count: int) -> list[float]:
    """Finite numbers of a list of known length; ValueError for anything else."""
    if not isinstance(values, list) or len(values) != count:
        raise ValueError(f"{str(values)[:60]}, expected {count} numbers")
    floats = [float(value) for value in values]
    if not np.isfinite(floats).all():
        raise ValueError(f"{str(values)[:60]}, expected finite numbers")
    return floats


def pack_glb(content: dict[str, Any], binary: bytes, least: int = 0) -> bytes:
    """A ``.glb`` of a description, padded to at least ``least`` bytes, and binary data."""
    text = _description(content, least)
    pad = bytes(-len(binary) % 4)
    size = 12 + 2 * _CHUNK.size + len(text) + len(binary) + len(pad)
    return b"".join(
        [
            struct.pack("<4sII", MAGIC, 2, size),
            _CHUNK.pack(len(text), b"JSON"),
            text,
            _CHUNK.pack(len(binary) + len(pad), b"BIN\0"),
            binary,
            pad,
        ]
    )


def pack_gltf(content: dict[str, Any], binary: bytes, least: int = 0) -> bytes:
    """A ``.gltf`` of a description, padded to at least ``least`` bytes, and binary data in its text
    as base64."""
    mark = "data:application/octet-stream;base64,"
    buffer = {"byteLength": len(binary), "uri": mark}
    text = _description({**content, "buffers": [buffer] if binary else []}, least)
    head, found, tail = text.partition(mark.encode())
    return b"".join([head, found, base64.b64encode(binary), tail])


def packed_size(description: int, binary: int, text: bool = False) -> int:
    """Size of a ``.glb``, or of a ``.gltf`` (``text``), with a description and binary data of these
    sizes, in bytes."""
    if text:
        return description + 4 * -(-binary // 3)
    return 12 + 2 * _CHUNK.size + description + -(-binary // 4) * 4


def buffer_views(parts: Sequence[bytes]) -> list[dict[str, Any]]:
    """Descriptions of consecutive parts, each a multiple of four bytes, of the first buffer."""
    starts = np.cumsum([0, *map(len, parts)]).tolist()
    return [
        {"buffer": 0, "byteOffset": start, "byteLength": len(part), "target": 34962}
        for start, part in zip(starts, parts, strict=False)
    ]


def _description(content: dict[str, Any], least: int) -> bytes:
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    return text.ljust(max(least, -(-len(text) // 4) * 4))


def _chunks(stream: BinaryIO, path: Path) -> tuple[tuple[int, int], tuple[int, int] | None]:
    """Start and size of the JSON of a ``.glb``, and of its binary chunk if it has one. The stream
    is behind the magic number."""
    stored = path.stat().st_size
    head = stream.read(8)
    if len(head) < 8:
        raise SceneError(f"{path}: truncated; a .glb has a header of 12 bytes, found {stored}")
    version, size = struct.unpack("<II", head)
    if version != 2:
        raise SceneError(f"{path}: glTF of version {version}; expected 2")
    if size > stored:
        raise SceneError(f"{path}: truncated; {size} bytes expected, found {stored}")
    found: list[tuple[int, int]] = []
    at = 12
    for wanted in (b"JSON", b"BIN\0"):
        stream.seek(at)
        chunk = stream.read(_CHUNK.size)
        if len(chunk) < _CHUNK.size:
            break
        length, kind = _CHUNK.unpack(chunk)
        at += _CHUNK.size
        if kind != wanted or at + length > size:
            break
        found.append((at, length))
        at += length
    if not found:
        raise SceneError(f"{path}: damaged glTF file (no chunk of JSON at byte 12)")
    return found[0], found[1] if len(found) > 1 else None


def _bytes_at(path: Path, start: int, size: int) -> memoryview:
    """Bytes of a file, fewer if it ends before."""
    with failure_named(path, "read"), open_regular(path) as stream:
        size = max(min(size, path.stat().st_size - start), 0)
        require_memory(path, size)
        stream.seek(start)
        return memoryview(stream.read(size))


def _is_whole(number: Any) -> bool:
    return isinstance(number, int) and not isinstance(number, bool) and 0 <= number < 1 << 62


def _component(code: Any) -> np.dtype:
    if code not in _COMPONENTS:
        raise ValueError(
            f"numbers of type {code!r}, expected one of {', '.join(map(str, _COMPONENTS))}"
        )
    return np.dtype(_COMPONENTS[code])


def _as_floats(values: Array, normalized: bool) -> Array:
    floats = values.astype(np.float32)
    if normalized and values.dtype.kind in "iu":
        floats = np.maximum(floats / np.float32(np.iinfo(values.dtype).max), np.float32(-1))
    return floats
