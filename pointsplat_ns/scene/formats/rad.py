"""RAD, the format of Spark: a tree of Gaussians in pages of 65,536, loaded on demand.

A file is a description in JSON, followed by the pages. A page is a description and one array per
attribute, component by component, deflated. The root is the first Gaussian; the children of a
Gaussian are consecutive. Reading gives the leaves, the finest level.
"""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.formats import coding
from pointsplat_ns.scene.formats.coding import Array, Blocks, shares_of_dc, to_bytes, unit_quats
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.scene.offsets import OFFSET_COMMENT, offset_of_text, offset_text
from pointsplat_ns.system.files import require_file
from pointsplat_ns.system.progress import Progress, silent

MOST_CHILDREN = 65535

MAGIC = b"RAD0"
PAGE_MAGIC = b"RADC"

_PAGE = 65536
_SH_SIZES = {1: 9, 2: 15, 3: 21}
_COMPONENTS = {"center": 3, "alpha": 1, "rgb": 3, "scales": 3, "orientation": 3, "sh_label": 1}
_COMPONENTS |= {f"sh{d}": size for d, size in _SH_SIZES.items()}
_COMPONENTS |= {f"sh{d}_code": size for d, size in _SH_SIZES.items()}
_COMPONENTS |= {"child_count": 1, "child_start": 1}
_TYPES = {"f32": "<f4", "f16": "<f2", "f32_lebytes": "<f4", "f16_lebytes": "<f2", "ln_f16": "<f2"}
_TYPES |= {"r8": "u1", "r8_delta": "u1", "s8": "i1", "s8_delta": "i1", "ln_0r8": "u1"}
_TYPES |= {"oct88r8": "u1", "u16": "<u2", "u32": "<u4"}


def encode_rad(
    scene: Gaussians, children: Tensor, starts: Tensor, progress: Progress = silent
) -> bytes:
    """Encode a tree of Gaussians as a RAD file.

    Args:
        scene: the N Gaussians of all levels, float32 on the CPU.
        children: (N,) number of children of each Gaussian, at most :data:`MOST_CHILDREN`.
        starts: (N,) index of the first child.
        progress: called during compression.
    """
    n = len(scene)
    degree = scene.sh_degree
    encoding = _ranges(scene)
    pages: list[bytes] = []
    places: list[dict[str, int]] = []
    offset = 0
    for first in range(0, n, _PAGE):
        progress("compressing", first / n)
        rows = slice(first, first + _PAGE)
        payload: list[bytes] = []
        properties: list[dict[str, Any]] = []
        size = 0
        for (name, kind, bounds), array in _attributes(
            scene[rows], encoding, children[rows], starts[rows]
        ):
            packer = zlib.compressobj(6, zlib.DEFLATED, -15)  # 9 takes three times as long for 1 %
            packed = packer.compress(array.tobytes()) + packer.flush()
            about = {
                "offset": size,
                "bytes": len(packed),
                "property": name,
                "encoding": kind,
                "compression": "gz",
            }
            properties.append({**about, **bounds})
            payload.append(_padded(packed))
            size += len(payload[-1])
        page: dict[str, Any] = {
            "version": 1,
            "base": first,
            "count": len(children[rows]),
            "payloadBytes": size,
        }
        page.update(maxSh=degree, lodTree=True, splatEncoding=encoding, properties=properties)
        pages.append(b"".join([_described(PAGE_MAGIC, page), struct.pack("<Q", size), *payload]))
        places.append({"offset": offset, "bytes": len(pages[-1])})
        offset += len(pages[-1])
    head: dict[str, Any] = {
        "version": 1,
        "type": "gsplat",
        "count": n,
        "maxSh": degree,
        "lodTree": True,
    }
    head.update(chunkSize=_PAGE, allChunkBytes=offset, chunks=places, splatEncoding=encoding)
    if scene.offset is not None:
        head["comment"] = OFFSET_COMMENT + offset_text(scene.offset)
    return b"".join([_described(MAGIC, head), *pages])


def read_rad(path: Path | str) -> Gaussians:
    """Read the leaves of a RAD file, or all Gaussians of one without a tree, as
    :func:`~pointsplat_ns.scene.read_scene` does. Pages may be files beside it.

    Raises:
        SceneError: if the file is damaged, or declares more than it holds.
    """
    path = require_file(path, "a RAD file")
    with coding.damage_named(path, "RAD"):
        data = coding.load_bytes(path)
        head, start = _description(data, MAGIC, path)
        if head.get("version") != 1 or head.get("type") != "gsplat":
            raise SceneError(
                f"{path}: RAD of type {head.get('type')!r} and version {head.get('version')!r}; "
                "expected gsplat 1"
            )
        pages = [_page_bytes(path, data, start, place) for place in head["chunks"]]
        count = int(head["count"])
        degree = min(max(int(head.get("maxSh") or 0), 0), MAX_SH_DEGREE)
        packed = sum(map(len, pages))
        stored = len(data) + sum(part.stat().st_size for part in rad_parts(path)[1:])
        if count < 0 or packed > stored:
            raise ValueError(f"{count} Gaussians in pages of {packed} bytes, of {stored}")
        coding.require_plausible(path, 16 * count, packed, count, (degree + 1) ** 2 - 1)
        columns = _joined([_read_page(page, count, path) for page in pages], count)
        return _leaves(columns, count, degree).replace(offset=_offset_of(head))


def rad_parts(path: Path) -> list[Path]:
    """A RAD file and those of its pages. Raises SceneError as :func:`read_rad`."""
    with coding.damage_named(path, "RAD"):
        head, _ = _description(coding.load_bytes(path), MAGIC, path)
        files = [place["filename"] for place in head["chunks"] if "filename" in place]
        return [path, *(coding.file_beside(path, name) for name in files if name is not None)]


def _page_bytes(path: Path, data: bytes, start: int, place: dict[str, Any]) -> memoryview:
    """The bytes of one page, in the file or in a file beside it."""
    size = int(place["bytes"])
    first = start + int(place["offset"])
    whole = memoryview(data)
    if place.get("filename") is not None:
        beside = coding.file_beside(path, place["filename"])
        whole = memoryview(coding.load_bytes(require_file(beside, "a page of a RAD file")))
        first = int(place["offset"])
    if min(first, size) < 0 or first + size > len(whole):
        raise SceneError(
            f"{path}: truncated; a page of {size} bytes at byte {first}, found {len(whole)} in all"
        )
    return whole[first : first + size]


def _description(data: bytes | memoryview, magic: bytes, path: Path) -> tuple[dict[str, Any], int]:
    """The JSON at the start of a file or page, and where its data begins."""
    if bytes(data[:4]) != magic:
        raise SceneError(f"{path}: not RAD (starts with {bytes(data[:4])!r}); expected {magic!r}")
    blocks = Blocks(data, path, 4)
    length = int(blocks.take("<u4", 1)[0])
    content = json.loads(bytes(blocks.take("u1", length)))
    if not isinstance(content, dict):
        raise ValueError("its description is not an object")
    return content, 8 + length + -length % 8


def _read_page(page: memoryview, most: int, path: Path) -> tuple[int, dict[str, Array]]:
    """The number of Gaussians of a page, at most ``most``, and its columns (N, C)."""
    about, end = _description(page, PAGE_MAGIC, path)
    count = int(about["count"])
    if not 0 <= count <= most:
        raise ValueError(f"a page of {count} Gaussians, declared as {most} in all")
    columns: dict[str, Array] = {}
    for attribute in about["properties"]:
        name = attribute["property"]
        if name not in _COMPONENTS or attribute["encoding"] not in _TYPES:
            raise ValueError(f"{name!r} as {attribute['encoding']!r}")
        if name == "child_start":
            continue
        start, size = int(attribute["offset"]), int(attribute["bytes"])
        if min(start, size) < 0:
            raise ValueError(f"{name} at byte {start}")
        packed = Blocks(page, path, end + 8 + start).take("u1", size).tobytes()
        rows = most if name.endswith("_code") else count
        columns[name] = _values(attribute, _unpacked(attribute, packed, rows))
        if not name.endswith("_code") and len(columns[name]) != count:
            raise ValueError(f"{name} of {len(columns[name])} Gaussians, expected {count}")
    return count, columns


def _unpacked(attribute: dict[str, Any], packed: bytes, rows: int) -> bytes:
    """The bytes of an attribute. Decompresses no more than that many rows have."""
    name = attribute["property"]
    size = _COMPONENTS[name] * np.dtype(_TYPES[attribute["encoding"]]).itemsize
    if attribute.get("compression") is None:
        return packed
    if attribute["compression"] != "gz":
        raise ValueError(f"compression {attribute['compression']!r} of {name}")
    return zlib.decompressobj(-15).decompress(packed, size * rows + 1)


def _values(attribute: dict[str, Any], raw: bytes) -> Array:
    """The decoded numbers (N, C) of an attribute."""
    name, encoding = attribute["property"], attribute["encoding"]
    width = _COMPONENTS[name]
    kind = np.dtype(_TYPES[encoding])
    if len(raw) % (width * kind.itemsize):
        raise ValueError(f"{name} of {len(raw)} bytes")
    if encoding == "oct88r8":
        return _from_turns(np.frombuffer(raw, np.uint8).reshape(-1, 3))
    if encoding.endswith("_lebytes"):  # all lowest bytes come first
        planes = np.frombuffer(raw, np.uint8).reshape(kind.itemsize, width, -1)
        table = np.ascontiguousarray(planes.transpose(2, 1, 0)).view(kind)[..., 0]
    else:
        table = np.frombuffer(raw, kind).reshape(width, -1).T
    if encoding.endswith("_delta"):
        table = np.cumsum(table, axis=0, dtype=kind)
    if kind.kind == "f" or name in ("child_count", "sh_label"):
        values = table if kind.kind != "f" else table.astype(np.float32)
    else:
        values = _in_range(attribute, table.astype(np.float32))
    if name == "scales" and encoding not in ("ln_f16", "ln_0r8"):
        return np.log(values)
    return _with_w(values) if name == "orientation" else values


def _in_range(attribute: dict[str, Any], levels: Array) -> Array:
    """Numbers of bytes: within a range; of signed bytes, up to a maximum; or of log-scales, of
    which 0 is a flat axis."""
    high = np.float32(attribute["max"])
    if attribute["encoding"].startswith("s8"):
        return levels * (high / 127)
    low = np.float32(attribute["min"])
    if attribute["encoding"] == "ln_0r8":
        return np.where(levels == 0, -np.inf, low + (levels - 1) * ((high - low) / 254))
    return low + levels * ((high - low) / 255)


def _with_w(xyz: Array) -> Array:
    """Quaternions (N, 4) wxyz of their last three components; w is positive."""
    w = np.sqrt(np.clip(1 - np.square(xyz).sum(axis=1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], axis=1)


def _from_turns(codes: Array) -> Array:
    """Quaternions (N, 4) wxyz of :func:`_turns`."""
    x, y = (codes[:, :2].astype(np.float32) / 255 * 2 - 1).T
    z = 1 - np.abs(x) - np.abs(y)
    below = np.maximum(-z, 0)
    folded = [x - np.copysign(below, x), y - np.copysign(below, y), z]
    axes = np.stack(folded, axis=1)
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    half = codes[:, 2:].astype(np.float32) * np.float32(np.pi / 510)
    return np.concatenate([np.cos(half), axes * np.sin(half)], axis=1)


def _joined(pages: list[tuple[int, dict[str, Array]]], count: int) -> dict[str, Array]:
    """The columns of all pages; palettes are in the first."""
    found = sum(size for size, _ in pages)
    if found != count:
        raise ValueError(f"{found} Gaussians in its pages, declared as {count}")
    names = {name for size, columns in pages for name in columns if size}
    return {
        name: np.concatenate([columns[name] for _, columns in pages if name in columns])
        if name.endswith("_code")
        else np.concatenate([columns[name] for size, columns in pages if size])
        for name in names
    }


def _leaves(columns: dict[str, Array], count: int, degree: int) -> Gaussians:
    """The Gaussians without children."""
    if not count:
        return Gaussians.empty(degree)
    kept = columns["child_count"][:, 0] == 0 if "child_count" in columns else np.ones(count, bool)
    sh = [_sh_of(columns, band, kept) for band in range(1, degree + 1)]
    alphas = np.clip(columns["alpha"][kept, 0].astype(np.float64), 0.0, 1.0)
    return coding.scene_of(
        columns["center"][kept],
        columns["scales"][kept],
        columns["orientation"][kept],
        coding.logits_of_shares(alphas),
        (columns["rgb"][kept] - 0.5) / SH_C0,
        np.concatenate([np.empty((int(kept.sum()), 0, 3), np.float32), *sh], axis=1),
    )


def _sh_of(columns: dict[str, Array], degree: int, kept: Array) -> Array:
    """SH (N, 2 d + 1, 3) of a degree, from a palette if there is one."""
    if f"sh{degree}_code" not in columns:
        return columns[f"sh{degree}"][kept].reshape(-1, 2 * degree + 1, 3)
    return columns[f"sh{degree}_code"][columns["sh_label"][kept, 0]].reshape(-1, 2 * degree + 1, 3)


def _offset_of(head: dict[str, Any]) -> tuple[float, float, float] | None:
    comment = str(head.get("comment", ""))
    if not comment.startswith(OFFSET_COMMENT):
        return None
    return offset_of_text(comment.removeprefix(OFFSET_COMMENT))


def _described(magic: bytes, content: dict[str, Any]) -> bytes:
    text = json.dumps(content, separators=(",", ":"), allow_nan=False).encode()
    return magic + struct.pack("<I", len(text)) + _padded(text)


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 8)


def _ranges(scene: Gaussians) -> dict[str, Any]:
    """Ranges of bytes: of colours, of SH by degree, and of the sizes that viewers support."""
    colours = np.quantile(shares_of_dc(scene), [0.001, 0.999])
    finite = scene.scales[scene.scales.isfinite()].double().numpy()  # excludes flat axes
    sizes = np.quantile(finite, [0.001, 1.0]) if len(finite) else np.zeros(2)
    limits = {f"sh{degree}Max": 1.0 for degree in (1, 2, 3)}
    for degree in range(1, scene.sh_degree + 1):
        limits[f"sh{degree}Max"] = max(float(_band(scene, degree).abs().max()), 1e-3)
    return {
        "rgbMin": min(float(colours[0]), 0.0),
        "rgbMax": max(float(colours[1]), 1.0),
        "lnScaleMin": float(sizes[0]) - 0.5,
        "lnScaleMax": float(sizes[1]) + 0.5,
        **limits,
        "lodOpacity": True,
    }


def _band(scene: Gaussians, degree: int) -> Tensor:
    """SH coefficients (N, 3 * (2 d + 1)) of degree d, the three channels of each together."""
    return scene.features_rest[:, degree**2 - 1 : (degree + 1) ** 2 - 1].reshape(len(scene), -1)


def _attributes(
    scene: Gaussians, encoding: dict[str, Any], children: Tensor, starts: Tensor
) -> Iterator[tuple[tuple[str, str, dict[str, float]], Array]]:
    """Attributes of a page: name, encoding with range, and array, component by component."""
    low = encoding["rgbMin"]
    high = encoding["rgbMax"]
    bytes_of_means = (
        np.ascontiguousarray(scene.means.numpy().T.astype("<f4")).view(np.uint8).reshape(3, -1, 4)
    )
    yield ("center", "f32_lebytes", {}), np.ascontiguousarray(bytes_of_means.transpose(2, 0, 1))
    yield ("alpha", "f16", {}), scene.alphas.numpy().astype("<f2")
    colours = to_bytes(255 * (shares_of_dc(scene) - low) / (high - low))
    yield ("rgb", "r8", {"min": low, "max": high}), colours.T
    yield ("scales", "ln_f16", {}), scene.scales.clamp_min(-6e4).numpy().T.astype("<f2")
    yield ("orientation", "oct88r8", {}), _turns(unit_quats(scene))
    for degree in range(1, scene.sh_degree + 1):
        most = encoding[f"sh{degree}Max"]
        levels = (_band(scene, degree).double() * (127 / most)).round().clamp(-127, 127)
        yield (f"sh{degree}", "s8", {"min": -most, "max": most}), levels.to(torch.int8).numpy().T
    yield ("child_count", "u16", {}), children.numpy().astype("<u2")
    yield ("child_start", "u32", {}), starts.numpy().astype("<u4")


def _turns(quats: Array) -> Array:
    """Rotations (N, 4) wxyz as (N, 3) bytes: the axis in octahedral encoding, and the angle."""
    positive = np.where(quats[:, :1] < 0, -quats, quats)
    axes = positive[:, 1:]
    length = np.linalg.norm(positive[:, 1:], axis=1)
    axes = np.where(length[:, None] > 1e-6, axes, [1.0, 0.0, 0.0])
    x, y, z = (axes / np.abs(axes).sum(axis=1, keepdims=True)).T
    sign_x = np.where(x < 0, -1.0, 1.0)
    sign_y = np.where(y < 0, -1.0, 1.0)
    folded = [
        np.where(z < 0, (1 - np.abs(y)) * sign_x, x),
        np.where(z < 0, (1 - np.abs(x)) * sign_y, y),
    ]
    angle = 2 * np.arctan2(length, positive[:, 0]) / np.pi
    return to_bytes(255 * np.stack([0.5 * (folded[0] + 1), 0.5 * (folded[1] + 1), angle], axis=1))
