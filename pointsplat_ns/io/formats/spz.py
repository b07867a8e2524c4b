"""SPZ files: Niantic's format, 20 bytes a Gaussian and one for each SH coefficient, compressed.

Versions 2 and 3 are one gzip stream, with quaternions of three and four bytes. Version 4 has one zstd stream for each
attribute; it is read, and version 3 is written, which most viewers read. Positions are in fixed point of 24 bits. The
format's documentation wants axes right, up, back; what is read and written here keeps the axes that it has, as most
converters do.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.io.files import logger, require_file
from pointsplat_ns.io.formats.coding import (
    Array,
    Blocks,
    bytes_of_logits,
    damage_named,
    from_smallest_three,
    load_bytes,
    logits_of_bytes,
    require_plausible,
    scene_of,
    smallest_three,
    to_bytes,
    unit_quats,
)
from pointsplat_ns.io.formats.rounding import Rounding, rounded
from pointsplat_ns.io.formats.spz_range import COLOUR_SCALE, MAX_FRACTION_BITS, SIZES, fitted, fraction_bits
from pointsplat_ns.system.progress import Progress, silent

SH_BITS = (6, 5)
"""Bits that are kept of SH coefficients, of degree 1 and of the others, unless they have at most 8 bits already. Fewer
compress better. The format's own programs keep 5 and 4, in a file a seventh smaller."""

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")  # magic, version, Gaussians, SH degree, bits after the point, flags, streams
_FIRST_RECORD = 32  # bytes of version 4 before extensions
_ANTIALIASED, _EXTENDED = 1, 2  # flags
_XYZW = np.array([1, 2, 3, 0])  # SPZ has w last


@dataclass(frozen=True)
class _Head:
    version: int
    count: int
    degree: int
    fraction_bits: int
    flags: int
    streams: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of positions, opacities, colours, scales, quaternions and SH."""
        n = self.count
        return (9 * n, n, 3 * n, 3 * n, (3 if self.version == 2 else 4) * n, 3 * ((self.degree + 1) ** 2 - 1) * n)


def read_spz(path: Path | str) -> Gaussians:
    """Read an SPZ file of version 2, 3 or 4, as :func:`~pointsplat_ns.io.read_scene` does. The axes stay those of the
    file. Of SH degree 4, the highest band is left out, and extensions are not read, which is logged. Raises SceneError
    if the file is of another kind or version, is truncated, or declares more than it can hold."""
    path = require_file(path, "an SPZ file")
    with damage_named(path, "SPZ"):
        return decode_spz(load_bytes(path), path)


def decode_spz(data: bytes, path: Path) -> Gaussians:
    """The scene in the bytes of an SPZ file, those Gaussians included that cannot be drawn. ``path`` is what errors
    name, which are those of :func:`read_spz`."""
    if data[:2] == b"\x1f\x8b":
        head, parts = _parts_of_gzip(data, path)
    elif data[:4] == _MAGIC:
        head, parts = _parts_of_zstd(data, path)
    else:
        raise SceneError(f"{path}: not an SPZ file (starts with {data[:4]!r}); expected gzip or {_MAGIC!r}")
    if head.flags & _EXTENDED:
        logger.warning("%s: extensions of the SPZ file are not read", path)
    if head.degree > MAX_SH_DEGREE:
        logger.warning("%s: SH degree %d, read up to degree %d", path, head.degree, MAX_SH_DEGREE)
    return _decode(head, parts).replace(antialiased=bool(head.flags & _ANTIALIASED))


def encode_spz(scene: Gaussians, progress: Progress = silent, level: int = 9) -> bytes:
    """The bytes of an SPZ file of version 3. The scene is brought into its range as by
    :func:`~pointsplat_ns.io.formats.spz_range.fitted`. SH that were read from an SPZ file, or were rounded for one,
    stay as they are.

    Args:
        scene: N Gaussians, float32 on the CPU.
        progress: called while compressing.
        level: of gzip, 1 to 9. 6 takes a tenth of the time of 9, for 3 % more bytes.

    Raises:
        SceneError: if the scene is too large for the format.
    """
    levels = 128 * scene.features_rest
    sh_bits = (8, 8) if torch.equal(levels, levels.round()) else SH_BITS
    n, flags = len(scene), _ANTIALIASED if scene.antialiased else 0
    scene, _ = fitted(scene)
    bits = fraction_bits(scene)
    parts = _encode(scene, bits, sh_bits)
    packer = zlib.compressobj(level, zlib.DEFLATED, 31)
    packed = [packer.compress(_HEADER.pack(_MAGIC, 3, n, scene.sh_degree, bits, flags, 0))]
    for index, part in enumerate(parts):
        progress("compressing", index / len(parts))
        packed.append(packer.compress(part))
    return b"".join([*packed, packer.flush()])


def rounded_for_spz(scene: Gaussians, rounding: Rounding) -> Gaussians:
    """A scene that takes fewer bytes as SPZ: its numbers are rounded (:mod:`~pointsplat_ns.io.formats.rounding`), those
    of SH to at most 8 bits. Arguments as of :func:`~pointsplat_ns.io.formats.rounding.rounded`."""
    small = rounded(fitted(scene)[0], rounding) if rounding.tolerance else scene
    if small is scene:
        return scene
    return small.replace(features_rest=(128 * small.features_rest).round().clamp(-128, 127) / 128)


def _head(data: bytes, path: Path) -> _Head:
    if len(data) < _HEADER.size:
        raise SceneError(f"{path}: truncated; an SPZ header has {_HEADER.size} bytes, found {len(data)}")
    magic, *numbers = _HEADER.unpack(data[: _HEADER.size])
    head = _Head(*numbers)
    if magic != _MAGIC or not 2 <= head.version <= 4:
        raise SceneError(f"{path}: SPZ of {magic!r} and version {head.version}; expected {_MAGIC!r}, version 2, 3 or 4")
    if head.degree > 4:
        raise SceneError(f"{path}: SH degree {head.degree}; expected 0 to 4")
    if head.fraction_bits > MAX_FRACTION_BITS:
        raise SceneError(
            f"{path}: {head.fraction_bits} bits after the point; expected at most {MAX_FRACTION_BITS} of 24"
        )
    return head


def _parts_of_gzip(data: bytes, path: Path) -> tuple[_Head, list[bytes | memoryview]]:
    """Header and attributes of versions 2 and 3. No more is decompressed than the header declares."""
    try:
        head = _head(zlib.decompressobj(31).decompress(data, _HEADER.size), path)
        if head.version == 4:
            raise SceneError(f"{path}: SPZ of version 4 inside gzip; expected version 2 or 3 there")
        rest = (head.degree + 1) ** 2 - 1
        size = _HEADER.size + sum(head.sizes)
        require_plausible(path, size, len(data), head.count, rest)
        content = zlib.decompressobj(31).decompress(data, size)
    except zlib.error as error:
        raise SceneError(f"{path}: damaged SPZ file ({error})") from error
    blocks = Blocks(content, path, _HEADER.size)
    return head, [blocks.take("u1", length).data for length in head.sizes]


def _parts_of_zstd(data: bytes, path: Path) -> tuple[_Head, list[bytes | memoryview]]:
    """Header and attributes of version 4. No more is decompressed than the header declares."""
    from zstandard import ZstdDecompressor, ZstdError

    head = _head(data, path)
    if head.version != 4:
        raise SceneError(f"{path}: SPZ of version {head.version} outside gzip; expected version 4 there")
    require_plausible(path, sum(head.sizes), len(data), head.count, (head.degree + 1) ** 2 - 1)
    sizes = [size for size in head.sizes if size]
    table = int(Blocks(data, path, _HEADER.size).take("<u4", 1)[0])  # where it begins; extensions are before it
    if head.streams != len(sizes) or table < _FIRST_RECORD:
        raise SceneError(
            f"{path}: {head.streams} streams listed at byte {table}; expected {len(sizes)} from byte {_FIRST_RECORD} on"
        )
    blocks = Blocks(data, path, table)
    lengths = blocks.take("<u8", len(sizes), 2).tolist()
    parts: list[bytes | memoryview] = []
    for (packed, unpacked), size in zip(lengths, sizes, strict=True):
        if unpacked != size:
            raise SceneError(f"{path}: a stream of {unpacked} bytes for {head.count} Gaussians; expected {size}")
        stream = blocks.take("u1", packed)
        try:
            with ZstdDecompressor().stream_reader(stream.data) as reader:
                part = reader.read(size)
        except ZstdError as error:
            raise SceneError(f"{path}: damaged SPZ file ({error})") from error
        if len(part) != size:
            raise SceneError(f"{path}: truncated; a stream ends after {len(part)} of {size} bytes")
        parts.append(part)
    return head, parts + [b""] * (len(head.sizes) - len(parts))


def _decode(head: _Head, parts: list[bytes | memoryview]) -> Gaussians:
    n, rest = head.count, (head.degree + 1) ** 2 - 1
    positions, alphas, colors, scales, quats, sh = (np.frombuffer(part, np.uint8) for part in parts)
    kept = min(rest, (MAX_SH_DEGREE + 1) ** 2 - 1)
    return scene_of(
        _from_fixed_point(positions.reshape(n, 3, 3), head.fraction_bits),
        scales.reshape(n, 3).astype(np.float32) * np.float32(SIZES.step) + np.float32(SIZES.low),
        _quats_of_three(quats) if head.version == 2 else _quats_of_four(quats),
        logits_of_bytes(alphas),
        (colors.reshape(n, 3).astype(np.float32) / 255 - 0.5) / COLOUR_SCALE,
        (sh.reshape(n, rest, 3)[:, :kept].astype(np.float32) - 128) / 128,
    )


def _encode(scene: Gaussians, bits: int, sh_bits: tuple[int, int]) -> list[bytes]:
    """The attributes in the file's order."""
    bands = scene.features_rest[:, :3], scene.features_rest[:, 3:]  # degree 1, and those above
    first, other = (_coarse(rest.numpy(), kept) for rest, kept in zip(bands, sh_bits, strict=True))
    fixed = np.rint(np.ldexp(scene.means.double().numpy(), bits)).astype("<i4")
    largest, others = smallest_three(unit_quats(scene)[:, _XYZW])
    magnitudes = np.rint(np.abs(others) * 2**0.5 * 511).astype(np.uint32) | (others < 0).astype(np.uint32) << 9
    words = largest.astype(np.uint32) << 30 | magnitudes[:, 0] << 20 | magnitudes[:, 1] << 10 | magnitudes[:, 2]
    return [
        np.ascontiguousarray(fixed[..., None]).view(np.uint8)[..., :3].tobytes(),
        bytes_of_logits(scene).tobytes(),
        to_bytes((scene.features_dc.double().numpy() * COLOUR_SCALE + 0.5) * 255).tobytes(),
        to_bytes((scene.scales.double() - SIZES.low) / SIZES.step).tobytes(),
        words.astype("<u4").tobytes(),
        np.concatenate([first, other], axis=1).tobytes(),
    ]


def _coarse(coefficients: Array, bits: int) -> Array:
    """SH coefficients as bytes of which only the upper ``bits`` differ; 0 stays 0."""
    step = 1 << (8 - bits)
    levels = np.rint(coefficients.astype(np.float64) * 128 / step) * step + 128
    return np.clip(levels, 0, 255).astype(np.uint8)


def _from_fixed_point(parts: Array, bits: int) -> Array:
    """Positions (N, 3) of three bytes each (N, 3, 3), the lowest first."""
    low, middle, high = (parts[..., i].astype(np.int32) for i in range(3))
    signed = (low | middle << 8 | high << 16) << 8 >> 8  # the upper bit becomes the sign
    return np.ldexp(signed.astype(np.float32), -bits)


def _quats_of_three(packed: Array) -> Array:
    """Version 2: x, y and z in a byte each; w is positive."""
    xyz = packed.reshape(-1, 3).astype(np.float32) / 127.5 - 1
    w = np.sqrt(np.clip(1 - np.square(xyz).sum(axis=1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], axis=1)


def _quats_of_four(packed: Array) -> Array:
    """From version 3 on: which component is largest, and nine bits and a sign for each of the others."""
    words = packed.view("<u4")
    levels = np.stack([words >> shift & 511 for shift in (20, 10, 0)], axis=1).astype(np.float32) / 511
    negative = np.stack([words >> shift & 512 for shift in (20, 10, 0)], axis=1) > 0
    others = np.where(negative, -levels, levels) * 0.5**0.5
    quats = np.empty((len(words), 4), np.float32)
    quats[:, _XYZW] = from_smallest_three((words >> 30).astype(np.int64), others)
    return quats
