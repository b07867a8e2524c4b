"""PlayCanvas' compressed PLY: 16 bytes a Gaussian, and one for each SH coefficient.

Gaussians are grouped in chunks of 256. For each chunk the file has the bounds of positions, log-scales and colours; a
Gaussian is four 32-bit words of bits between these bounds, and a quaternion without its largest component.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import PLAIN, Gaussians, Traits, sh_degree_of
from pointsplat_ns.io.files import require_file, require_memory
from pointsplat_ns.io.formats.coding import (
    Array,
    Blocks,
    bytes_of_logits,
    damage_named,
    dc_of_shares,
    from_smallest_three,
    load_bytes,
    logits_of_bytes,
    morton_order,
    scene_of,
    shares_of_dc,
    smallest_three,
    unit_quats,
)
from pointsplat_ns.io.formats.holding import FLOAT, Holds, Span, within_colours
from pointsplat_ns.io.ply_header import Element, Header, first_lines, read_header, traits_of
from pointsplat_ns.io.usable import keep_usable
from pointsplat_ns.system.progress import Progress, silent

CHUNK_GAUSSIANS = 256
"""Gaussians that share bounds."""

_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = tuple(
    f"{end}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for end in ("min", "max")
    for name in names
)
_BITS_3 = ((21, 11), (11, 10), (0, 11))  # shift and number of bits of each of three numbers in a word
_BITS_4 = ((24, 8), (16, 8), (8, 8))  # of four numbers; the last is opacity
_ROTATION_BITS = ((20, 10), (10, 10), (0, 10))
SIZES, SH = Span(-20.0, 20.0), Span(-4.0, 4.0, 8 / 256)
"""Log-scales, whose bounds must be finite, and SH coefficients above degree 0."""


def is_compressed(header: Header) -> bool:
    """Whether a PLY's header is that of a compressed one."""
    return any(name in _PACKED for element in header.elements for name, _ in element.properties)


def read_compressed_ply(path: Path | str) -> Gaussians:
    """Read a compressed PLY, of any SH degree up to 3, as :func:`~pointsplat_ns.io.read_scene` does. Raises SceneError
    if the file is no compressed PLY, is truncated, or does not fit into memory."""
    path = require_file(path, "a compressed PLY file")
    with damage_named(path, "compressed PLY"):
        with path.open("rb") as stream:
            header = read_header(stream, path)
        elements = {element.name: element for element in header.elements}
        chunk, vertex, sh = (elements.get(name) for name in ("chunk", "vertex", "sh"))
        if chunk is None or vertex is None:
            raise SceneError(f"{path}: lacks the element {'vertex' if chunk else 'chunk'!r}; expected a compressed PLY")
        rest = _check(header, chunk, vertex, sh, path)
        require_memory(path, path.stat().st_size + 4 * vertex.count * (14 + 3 * rest))
        blocks = Blocks(load_bytes(path), path, header.size)
        data = {element.name: blocks.take(_dtype(element), element.count) for element in header.elements}
        scene = _decode(data["chunk"], data["vertex"], data.get("sh"), rest)
        scene = scene.replace(**traits_of(header, path)._asdict())
    return keep_usable(scene, path)


def compressed_ply_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> int:
    """Size of a compressed PLY of ``count`` Gaussians, bytes."""
    rest = 3 * ((sh_degree + 1) ** 2 - 1)
    chunks = -(-count // CHUNK_GAUSSIANS)
    return len(_header_text(count, rest, traits)) + 4 * len(_BOUNDS) * chunks + (16 + rest) * count


def encode_compressed_ply(scene: Gaussians, progress: Progress = silent) -> bytes:
    """The bytes of a compressed PLY of a scene, float32 on the CPU. Gaussians are reordered, so that those of a chunk
    are near each other. ``progress`` is not called."""
    n = len(scene)
    scene = fitted(scene)[0][morton_order(scene)]
    scales = scene.scales.double().clamp(SIZES.low, SIZES.high).numpy()
    parts = (scene.means.double().numpy(), scales, shares_of_dc(scene))
    bounds = [_bounds(part) for part in parts]
    chunks = np.concatenate([side for low_high in bounds for side in low_high], axis=1).astype("<f4")
    shares = [_shares(part, chunks[:, 6 * i : 6 * i + 6]) for i, part in enumerate(parts)]
    largest, others = smallest_three(unit_quats(scene))
    rotation = _pack(others / 2**0.5 + 0.5, _ROTATION_BITS) | largest.astype(np.uint32) << 30
    opacity = bytes_of_logits(scene).astype(np.uint32)
    words = (
        _pack(shares[0], _BITS_3),
        rotation,
        _pack(shares[1], _BITS_3),
        _pack(shares[2], _BITS_4) | opacity,
    )
    rest = scene.features_rest.transpose(1, 2).flatten(1).double().numpy()
    sh = np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8)  # of [-4, 4]
    packed = np.stack(words, axis=1).astype("<u4")
    header = _header_text(n, rest.shape[1], scene.traits)
    return b"".join((header, chunks.tobytes(), packed.tobytes(), sh.tobytes()))


def fitted(scene: Gaussians) -> tuple[Gaussians, str]:
    """A scene with colours and SH in the range of the format, as by
    :func:`~pointsplat_ns.io.formats.holding.within_colours`; nothing is moved."""
    return within_colours(scene, FLOAT, SH), ""


def _steps(values: Array, scene: Gaussians, bits: tuple[tuple[int, int], ...]) -> Tensor:
    """The largest step (N,) of values (N, 3) in the chunk of each Gaussian."""
    order = morton_order(scene)
    low, high = _bounds(values[order.numpy()])
    spans = (high - low) / np.array([(1 << n) - 1 for _, n in bits])
    of_rows = torch.from_numpy(spans.max(axis=1).repeat(CHUNK_GAUSSIANS)[: len(values)])
    return torch.empty_like(of_rows).index_copy_(0, order, of_rows)


_CHUNK = f"{_BITS_3[0][1]} or {_BITS_3[1][1]} bits within {CHUNK_GAUSSIANS} neighbours"
HOLDS = Holds(
    positions=Span(how=_CHUNK),
    sizes=replace(SIZES, how=_CHUNK),
    colours=Span(how=f"{_BITS_4[0][1]} bits within {CHUNK_GAUSSIANS} neighbours"),
    opacities=Span(0.0, 1.0, 1 / 255),
    rotations=Span(-(0.5**0.5), 0.5**0.5, 2**0.5 / 1023),
    sh=SH,
    offset=True,
    position_steps=lambda scene: _steps(scene.means.double().numpy(), scene, _BITS_3),
    colour_steps=lambda scene: _steps(scene.features_dc.double().numpy(), scene, _BITS_4),
    fitted=fitted,
)


def _header_text(count: int, rest: int, traits: Traits) -> bytes:
    lines = [*first_lines(traits), f"element chunk {-(-count // CHUNK_GAUSSIANS)}"]
    lines += [f"property float {name}" for name in _BOUNDS]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(rest))]
    return "\n".join([*lines, "end_header", ""]).encode()


def _check(header: Header, chunk: Element, vertex: Element, sh: Element | None, path: Path) -> int:
    """SH coefficients per channel beyond the constant one; checks what the header declares against itself and the
    file's size."""
    if header.order != "<":
        raise SceneError(f"{path}: a compressed PLY in another byte order or ASCII; expected binary_little_endian")
    listed = [name for element in header.elements for name in element.lists]
    if listed:
        raise SceneError(f"{path}: property {listed[0]!r} is a list; expected none in a compressed PLY")
    colours = [name for name in _BOUNDS[12:] if name not in dict(chunk.properties)]
    needed = {"chunk": (chunk, _BOUNDS[:12] if len(colours) == 6 else _BOUNDS), "vertex": (vertex, _PACKED)}
    for name, (element, names) in needed.items():
        kind = "float32" if name == "chunk" else "uint32"
        wrong = [prop for prop in names if dict(element.properties).get(prop) != kind]
        if wrong:
            raise SceneError(f"{path}: element {name!r} lacks the {kind} property {wrong[0]!r}")
    wanted = -(-vertex.count // CHUNK_GAUSSIANS)
    if chunk.count != wanted:
        raise SceneError(f"{path}: {chunk.count} chunks for {vertex.count} Gaussians; expected {wanted}")
    rest = 0
    if sh is not None:
        expected = [f"f_rest_{i}" for i in range(len(sh.properties))]
        bad = [prop for prop, kind in sh.properties if kind != "uint8" or prop not in expected]
        if bad or sh.count != vertex.count or len(expected) % 3:
            raise SceneError(
                f"{path}: element 'sh' has {sh.count} rows of {len(expected)} properties; expected {vertex.count} rows "
                "of f_rest_0, f_rest_1, ... of type uchar"
            )
        rest = len(expected) // 3
        sh_degree_of(rest)
    size = header.size + sum(element.count * element.row_bytes for element in header.elements)
    if size > path.stat().st_size:
        raise SceneError(
            f"{path}: truncated; {vertex.count} Gaussians declared, {size} bytes; found {path.stat().st_size}"
        )
    return rest


def _dtype(element: Element) -> np.dtype:
    return np.dtype([(name, np.dtype(kind).newbyteorder("<")) for name, kind in element.properties])


def _decode(chunk: Array, vertex: Array, sh: Array | None, rest: int) -> Gaussians:
    of = np.arange(len(vertex)) // CHUNK_GAUSSIANS
    position, rotation, scale, color = (vertex[name] for name in _PACKED)

    def between(word: Array, bits: tuple[tuple[int, int], ...], names: tuple[str, ...]) -> Array:
        shares = _unpack(word, bits)
        if names[0] not in (chunk.dtype.names or ()):
            return shares
        low, high = (np.stack([chunk[name] for name in part], axis=1)[of] for part in (names[:3], names[3:]))
        return low + (high - low) * shares

    tops = (rotation >> 30).astype(np.int64)
    others = (_unpack(rotation, _ROTATION_BITS) - 0.5) * 2**0.5
    coefficients = np.empty((len(vertex), rest, 3), np.float32)
    for i in range(3 * rest if sh is not None else 0):
        assert sh is not None
        level = sh[f"f_rest_{i}"].astype(np.float32)
        share = np.where(level == 0, 0.0, np.where(level == 255, 1.0, (level + 0.5) / 256))
        coefficients[:, i % rest, i // rest] = (share - 0.5) * 8
    return scene_of(
        between(position, _BITS_3, _BOUNDS[:6]),
        between(scale, _BITS_3, _BOUNDS[6:12]),
        from_smallest_three(tops, others),
        logits_of_bytes(color & 255),
        dc_of_shares(between(color, _BITS_4, _BOUNDS[12:])),
        coefficients,
    )


def _unpack(words: Array, bits: tuple[tuple[int, int], ...]) -> Array:
    """Shares in [0, 1], (N, 3), in some bits of words (N,)."""
    return np.stack([(words >> shift & (1 << n) - 1).astype(np.float32) / ((1 << n) - 1) for shift, n in bits], axis=1)


def _pack(shares: Array, bits: tuple[tuple[int, int], ...]) -> Array:
    """Words (N,) of shares in [0, 1], (N, 3)."""
    words = np.zeros(len(shares), np.uint32)
    for column, (shift, n) in zip(shares.T, bits, strict=True):
        top = (1 << n) - 1
        words |= np.clip(np.rint(column * top), 0, top).astype(np.uint32) << shift
    return words


def _bounds(values: Array) -> tuple[Array, Array]:
    """Lowest and highest values (chunks, 3) of each chunk, as float32 that hold all of them."""
    starts = np.arange(0, len(values), CHUNK_GAUSSIANS)
    if not len(starts):
        return np.empty((0, 3)), np.empty((0, 3))
    return np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)


def _shares(values: Array, bounds: Array) -> Array:
    """Where values (N, 3) lie between the bounds (chunks, 6) that are written, 0 where these are equal."""
    of = np.arange(len(values)) // CHUNK_GAUSSIANS
    low, high = bounds[of, :3].astype(np.float64), bounds[of, 3:].astype(np.float64)
    span = high - low
    return np.where(span > 0, (values - low) / np.where(span > 0, span, 1), 0.0)
