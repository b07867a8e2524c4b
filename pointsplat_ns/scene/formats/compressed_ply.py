"""Reads PlayCanvas' compressed PLY: 16 bytes a Gaussian, and one per SH coefficient.

Gaussians are grouped in chunks of 256. Each chunk has bounds of positions, log-scales and colours.
A Gaussian is four 32-bit words: values between these bounds, and a quaternion without its largest
component.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.formats import coding
from pointsplat_ns.scene.formats.coding import Array, Blocks
from pointsplat_ns.scene.gaussians import Gaussians, sh_degree_of
from pointsplat_ns.scene.ply_header import Element, Header, read_header, traits_of
from pointsplat_ns.system.files import require_file, require_memory
from pointsplat_ns.system.opening import open_regular

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)


def is_compressed(header: Header) -> bool:
    """Whether a PLY header belongs to a compressed PLY."""
    return any(name in _PACKED for element in header.elements for name, _ in element.properties)


def read_compressed_ply(path: Path | str) -> Gaussians:
    """Read a compressed PLY of SH degree 0 to 3, as :func:`~pointsplat_ns.scene.read_scene` does.
    Raises SceneError if the file is not a compressed PLY, is truncated, or does not fit into
    memory."""
    path = require_file(path, "a compressed PLY file")
    with coding.damage_named(path, "compressed PLY"):
        with open_regular(path) as stream:
            header = read_header(stream, path)
        count, rest = _checked(header, path)
        require_memory(path, path.stat().st_size + 4 * count * (14 + 3 * rest))
        blocks = Blocks(coding.load_bytes(path), path, header.size)
        data = {
            element.name: blocks.take(_dtype(element), element.count) for element in header.elements
        }
        return _decode(data["chunk"], data["vertex"], data.get("sh"), rest).replace(
            **traits_of(header, path)._asdict()
        )


def _checked(header: Header, path: Path) -> tuple[int, int]:
    """The number of Gaussians, and of SH coefficients per channel beyond the constant one. Checks
    the header for consistency and against the file size."""
    elements = {element.name: element for element in header.elements}
    chunk, vertex, sh = (elements.get(name) for name in ("chunk", "vertex", "sh"))
    if chunk is None or vertex is None:
        raise SceneError(
            f"{path}: lacks the element {'vertex' if chunk else 'chunk'!r}; expected a compressed "
            "PLY"
        )
    if header.order != "<":
        raise SceneError(
            f"{path}: a big-endian or ASCII compressed PLY; expected binary_little_endian"
        )
    listed = [name for element in header.elements for name in element.lists]
    if listed:
        raise SceneError(
            f"{path}: property {listed[0]!r} is a list; expected none in a compressed PLY"
        )
    coloured = all(name in dict(chunk.properties) for name in _BOUNDS[12:])
    needed = [(chunk, "float32", name) for name in (_BOUNDS if coloured else _BOUNDS[:12])]
    for element, kind, name in needed + [(vertex, "uint32", name) for name in _PACKED]:
        if dict(element.properties).get(name) != kind:
            raise SceneError(f"{path}: element {element.name!r} lacks the {kind} property {name!r}")
    wanted = -(-vertex.count // 256)
    if chunk.count != wanted:
        raise SceneError(
            f"{path}: {chunk.count} chunks for {vertex.count} Gaussians; expected {wanted}"
        )
    rest = 0
    if sh is not None:
        rest = len(sh.properties) // 3
        expected = {(f"f_rest_{i}", "uint8") for i in range(3 * rest)}
        if set(sh.properties) != expected or sh.count != vertex.count:
            raise SceneError(
                f"{path}: element 'sh' has {sh.count} rows of {len(sh.properties)} properties; "
                f"expected {vertex.count} rows of f_rest_0, f_rest_1, ... of type uchar"
            )
        sh_degree_of(rest)
    size = header.size + sum(element.count * element.row_bytes for element in header.elements)
    if size > path.stat().st_size:
        raise SceneError(
            f"{path}: truncated; {vertex.count} Gaussians declared, {size} bytes; found "
            f"{path.stat().st_size}"
        )
    return vertex.count, rest


def _dtype(element: Element) -> np.dtype:
    return np.dtype([(name, np.dtype(kind).newbyteorder("<")) for name, kind in element.properties])


def _decode(chunk: Array, vertex: Array, sh: Array | None, rest: int) -> Gaussians:
    of = np.arange(len(vertex)) // 256
    position, rotation, scale, color = (vertex[name] for name in _PACKED)

    def between(shares: Array, names: tuple[str, ...]) -> Array:
        if names[0] not in (chunk.dtype.names or ()):
            return shares
        low, high = (
            np.stack([chunk[name] for name in part], axis=1)[of] for part in (names[:3], names[3:])
        )
        return low + (high - low) * shares

    coefficients = np.empty((len(vertex), rest, 3), np.float32)
    if sh is not None:
        for i in range(3 * rest):
            level = sh[f"f_rest_{i}"].astype(np.float32)
            share = np.where(level == 0, 0.0, np.where(level == 255, 1.0, (level + 0.5) / 256))
            coefficients[:, i % rest, i // rest] = (share - 0.5) * 8
    # Shift and width, bits, of three numbers in a word.
    eleven = ((21, 11), (11, 10), (0, 11))
    ten = ((20, 10), (10, 10), (0, 10))
    eight = ((24, 8), (16, 8), (8, 8))
    return coding.scene_of(
        between(_unpack(position, eleven), _BOUNDS[:6]),
        between(_unpack(scale, eleven), _BOUNDS[6:12]),
        coding.from_smallest_three(
            (rotation >> 30).astype(np.int64), (_unpack(rotation, ten) - 0.5) * 2**0.5
        ),
        coding.logits_of_bytes(color & 255),
        (between(_unpack(color, eight), _BOUNDS[12:]) - 0.5) / SH_C0,
        coefficients,
    )


def _unpack(words: Array, bits: tuple[tuple[int, int], ...]) -> Array:
    """Shares in [0, 1], (N, 3), from bit fields of words (N,)."""
    return np.stack(
        [(words >> shift & (1 << n) - 1).astype(np.float32) / ((1 << n) - 1) for shift, n in bits],
        axis=1,
    )
