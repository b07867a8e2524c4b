"""SPZ files: Niantic's compressed format, 20 bytes a Gaussian and one per SH coefficient.

Versions 2 and 3 are one gzip stream, with quaternions of three and four bytes. Version 4 has one
zstd stream per attribute. Versions 2 to 4 are read; version 3 is written, because most viewers read
it. Positions are 24-bit fixed point. The format's documentation requires axes right, up, back; axes
are not converted here, as in most converters.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.formats import coding
from pointsplat_ns.scene.formats.capacity import Holds, Span, typical_sizes, within_colours
from pointsplat_ns.scene.formats.coding import Array, Blocks
from pointsplat_ns.scene.formats.rounding import rounded
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.system.files import logger, require_file
from pointsplat_ns.system.progress import Progress, silent

FRACTION_BITS = 12
MAX_FRACTION_BITS = 23
"""Fractional bits of a position: the default, for steps of 0.00024 within 2048 units, and the
maximum. Scenes of smaller Gaussians get more, and scenes that reach farther get fewer."""

FARTHEST = 2**23 - 1
"""Largest distance of a position from the origin, in steps."""

_COLOUR_SCALE = 0.15
_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")  # magic, then the fields of _Head
# flags
_ANTIALIASED = 1
_EXTENDED = 2
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
    def rest(self) -> int:
        """SH coefficients per channel beyond the constant one."""
        return (self.degree + 1) ** 2 - 1

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of positions, opacities, colours, scales, quaternions and SH, in this order."""
        n = self.count
        return (9 * n, n, 3 * n, 3 * n, (3 if self.version == 2 else 4) * n, 3 * self.rest * n)


def read_spz(path: Path | str) -> Gaussians:
    """Read an SPZ file of version 2, 3 or 4, as :func:`~pointsplat_ns.scene.read_scene` does.

    Axes are not converted. The highest band of SH degree 4, and extensions, are not read; both are
    logged. Raises SceneError if the file has another format or version, is truncated, or declares
    more than it can hold.
    """
    path = require_file(path, "an SPZ file")
    with coding.damage_named(path, "SPZ"):
        data = coding.load_bytes(path)
        if data[:2] == b"\x1f\x8b":
            head, parts = _parts_of_gzip(data, path)
        elif data[:4] == _MAGIC:
            head, parts = _parts_of_zstd(data, path)
        else:
            raise SceneError(
                f"{path}: not an SPZ file (starts with {data[:4]!r}); expected gzip or {_MAGIC!r}"
            )
        if head.flags & _EXTENDED:
            logger.warning("%s: extensions of the SPZ file are not read", path)
        if head.degree > MAX_SH_DEGREE:
            logger.warning(
                "%s: SH degree %d, read up to degree %d", path, head.degree, MAX_SH_DEGREE
            )
        return _decode(head, parts).replace(antialiased=bool(head.flags & _ANTIALIASED))


def encode_spz(scene: Gaussians, progress: Progress = silent, level: int = 9) -> bytes:
    """Encode a scene as an SPZ file of version 3, after :func:`fitted` moved it into range.

    SH that were read from an SPZ file, or rounded for one, are unchanged. Others get 6 bits at
    degree 1 and 5 bits above, which compress better. The format's own programs use 5 and 4 bits, in
    a file a seventh smaller.

    Args:
        scene: N Gaussians, float32 on the CPU.
        progress: called during compression.
        level: gzip level, 1 to 9. 6 takes a tenth of the time of 9, for 3 % more bytes.

    Raises:
        SceneError: if the scene is too large for the format.
    """
    levels = 128 * scene.features_rest
    sh_bits = (8, 8) if torch.equal(levels, levels.round()) else (6, 5)
    n = len(scene)
    flags = _ANTIALIASED if scene.antialiased else 0
    scene, _ = fitted(scene)
    bits = fraction_bits(scene)
    parts = _encode(scene, bits, sh_bits)
    packer = zlib.compressobj(level, zlib.DEFLATED, 31)
    packed = [packer.compress(_HEADER.pack(_MAGIC, 3, n, scene.sh_degree, bits, flags, 0))]
    for index, part in enumerate(parts):
        progress("compressing", index / len(parts))
        packed.append(packer.compress(part))
    return b"".join([*packed, packer.flush()])


def rounded_for_spz(scene: Gaussians, tolerance: float) -> Gaussians:
    """A scene that takes fewer bytes as SPZ: its numbers are rounded as by
    :func:`~pointsplat_ns.scene.formats.rounding.rounded`, SH to at most 8 bits. A tolerance of 0
    changes nothing."""
    if not tolerance or not len(scene):
        return scene
    small = rounded(fitted(scene)[0], tolerance)
    return small.replace(features_rest=(128 * small.features_rest).round().clamp(-128, 127) / 128)


def fitted(scene: Gaussians) -> tuple[Gaussians, str]:
    """A scene, float32 on the CPU, moved into the range of SPZ, and a description of the moved
    Gaussians.

    If at most 1 % of the Gaussians are so far away that the positions of all others would become
    coarse, they move towards the median position and shrink in proportion: seen from there, they
    look the same. Colours are those of :func:`within_colours`.
    """
    assert HOLDS.sh is not None
    scene = within_colours(scene, HOLDS.colours, HOLDS.sh)
    if not len(scene):
        return scene, ""
    needed = _needed_bits(scene)
    if _fitting_bits(scene) >= needed:
        return scene, ""
    bits = max(needed, FRACTION_BITS)
    reach = math.ldexp(FARTHEST - 1, -bits)
    far = scene.means.abs().amax(dim=1) > reach
    count = int(far.sum())
    if count > math.ceil(0.01 * len(scene)) or count == len(scene):
        return scene, ""
    centre = scene.means[~far].double().median(dim=0).values
    ways = scene.means[far].double() - centre
    room = torch.where(ways < 0, reach + centre, reach - centre)
    share = (room / ways.abs().clamp_min(1e-300)).amin(dim=1).clamp_min(1e-6)
    means = scene.means.clone()
    scales = scene.scales.clone()
    means[far] = (centre + share[:, None] * ways).float()
    scales[far] += share.log()[:, None].float()
    moved = (
        f"Gaussians farther than {reach:.4g} units ({count}) are moved to that distance and shrunk "
        "in proportion"
    )
    return scene.replace(means=means, scales=scales), moved


def fraction_bits(scene: Gaussians) -> int:
    """Fractional bits of the positions of a scene that is :func:`fitted`. Raises SceneError if a
    Gaussian is out of range."""
    fitting = _fitting_bits(scene)
    bits = max(_needed_bits(scene), FRACTION_BITS)
    # read from an SPZ file, whose sizes are rounded
    if not _is_exact(scene, bits) and _is_exact(scene, bits + 1):
        bits += 1
    bits = min(fitting, bits)
    if bits < 0:
        farthest = float(scene.means.abs().max())
        raise SceneError(
            f"a Gaussian lies {farthest:.3g} units from the origin; SPZ reaches to {FARTHEST}; "
            "scale the scene down"
        )
    return bits


def _is_exact(scene: Gaussians, bits: int) -> bool:
    levels = scene.means.double() * 2.0**bits
    return torch.equal(levels, levels.round())


def _fitting_bits(scene: Gaussians) -> int:
    """Largest number of fractional bits with which all positions fit into 24 bits."""
    farthest = float(scene.means.abs().max()) if len(scene) else 0.0
    return min(
        math.floor(math.log2(FARTHEST / farthest)) if farthest > 0 else MAX_FRACTION_BITS,
        MAX_FRACTION_BITS,
    )


def _needed_bits(scene: Gaussians) -> int:
    """Fractional bits for which the median size of a Gaussian is at least 8 position steps."""
    if not len(scene):
        return FRACTION_BITS
    size = float(typical_sizes(scene).median())
    return min(max(math.ceil(math.log2(8 / size)), 0), MAX_FRACTION_BITS)


def _position_steps(scene: Gaussians) -> Tensor:
    return scene.means.new_full((len(scene),), math.ldexp(1.0, -fraction_bits(scene)))


HOLDS = Holds(
    sizes=Span(-10.0, -10.0 + 255 / 16, 1 / 16),
    colours=Span(-0.5 / _COLOUR_SCALE, 0.5 / _COLOUR_SCALE, 1 / (255 * _COLOUR_SCALE)),
    sh=Span(-1.0, 127 / 128, 1 / 128),
    position_steps=_position_steps,
    fitted=fitted,
)


def _head(data: bytes, versions: tuple[int, ...], packed: int, path: Path) -> _Head:
    """The checked header at the start of uncompressed data. Checks that a file of ``packed`` bytes
    can hold what it declares."""
    if len(data) < _HEADER.size:
        raise SceneError(
            f"{path}: truncated; an SPZ header has {_HEADER.size} bytes, found {len(data)}"
        )
    magic, *numbers = _HEADER.unpack(data[: _HEADER.size])
    head = _Head(*numbers)
    if magic != _MAGIC or head.version not in versions:
        raise SceneError(
            f"{path}: SPZ of {magic!r} and version {head.version}; expected {_MAGIC!r}, version 2 "
            "or 3 in gzip, or 4 outside"
        )
    if head.degree > 4:
        raise SceneError(f"{path}: SH degree {head.degree}; expected 0 to 4")
    if head.fraction_bits > MAX_FRACTION_BITS:
        raise SceneError(
            f"{path}: {head.fraction_bits} fractional bits; expected at most {MAX_FRACTION_BITS} "
            "of 24"
        )
    coding.require_plausible(path, sum(head.sizes), packed, head.count, head.rest)
    return head


def _parts_of_gzip(data: bytes, path: Path) -> tuple[_Head, list[bytes | memoryview]]:
    """Header and attributes of versions 2 and 3. Decompresses no more than the header declares."""
    head = _head(zlib.decompressobj(31).decompress(data, _HEADER.size), (2, 3), len(data), path)
    content = zlib.decompressobj(31).decompress(data, _HEADER.size + sum(head.sizes))
    blocks = Blocks(content, path, _HEADER.size)
    return head, [blocks.take("u1", length).data for length in head.sizes]


def _parts_of_zstd(data: bytes, path: Path) -> tuple[_Head, list[bytes | memoryview]]:
    """Header and attributes of version 4. Decompresses no more than the header declares."""
    from zstandard import ZstdDecompressor, ZstdError

    head = _head(data, (4,), len(data), path)
    sizes = [size for size in head.sizes if size]
    # start of the table; extensions come before it
    table = int(Blocks(data, path, _HEADER.size).take("<u4", 1)[0])
    if head.streams != len(sizes) or table < 32:
        raise SceneError(
            f"{path}: {head.streams} streams listed at byte {table}; expected {len(sizes)} from "
            "byte 32 on"
        )
    blocks = Blocks(data, path, table)
    lengths = blocks.take("<u8", len(sizes), 2).tolist()
    parts: list[bytes | memoryview] = []
    for (packed, unpacked), size in zip(lengths, sizes, strict=True):
        if unpacked != size:
            raise SceneError(
                f"{path}: a stream of {unpacked} bytes for {head.count} Gaussians; expected {size}"
            )
        stream = blocks.take("u1", packed)
        try:
            with ZstdDecompressor().stream_reader(stream.data) as reader:
                parts.append(reader.read(size))
        except ZstdError as error:
            raise SceneError(f"{path}: damaged SPZ file ({error})") from error
        if len(parts[-1]) != size:
            raise SceneError(
                f"{path}: truncated; a stream ends after {len(parts[-1])} of {size} bytes"
            )
    return head, parts + [b""] * (len(head.sizes) - len(parts))


def _decode(head: _Head, parts: list[bytes | memoryview]) -> Gaussians:
    n = head.count
    positions, alphas, colors, scales, quats, sh = (np.frombuffer(part, np.uint8) for part in parts)
    kept = min(head.rest, (MAX_SH_DEGREE + 1) ** 2 - 1)
    return coding.scene_of(
        _from_fixed_point(positions.reshape(n, 3, 3), head.fraction_bits),
        scales.reshape(n, 3).astype(np.float32) * np.float32(HOLDS.sizes.step)
        + np.float32(HOLDS.sizes.low),
        _quats_of_three(quats) if head.version == 2 else _quats_of_four(quats),
        coding.logits_of_bytes(alphas),
        (colors.reshape(n, 3).astype(np.float32) / 255 - 0.5) / _COLOUR_SCALE,
        (sh.reshape(n, head.rest, 3)[:, :kept].astype(np.float32) - 128) / 128,
    )


def _encode(scene: Gaussians, bits: int, sh_bits: tuple[int, int]) -> list[bytes]:
    """The attributes in file order."""
    bands = scene.features_rest[:, :3], scene.features_rest[:, 3:]  # degree 1, and above
    first, other = (_coarse(rest.numpy(), kept) for rest, kept in zip(bands, sh_bits, strict=True))
    fixed = np.rint(np.ldexp(scene.means.double().numpy(), bits)).astype("<i4")
    largest, others = coding.smallest_three(coding.unit_quats(scene)[:, _XYZW])
    magnitudes = (
        np.rint(np.abs(others) * 2**0.5 * 511).astype(np.uint32)
        | (others < 0).astype(np.uint32) << 9
    )
    words = (
        largest.astype(np.uint32) << 30
        | magnitudes[:, 0] << 20
        | magnitudes[:, 1] << 10
        | magnitudes[:, 2]
    )
    return [
        np.ascontiguousarray(fixed[..., None]).view(np.uint8)[..., :3].tobytes(),
        coding.bytes_of_logits(scene).tobytes(),
        coding.to_bytes((scene.features_dc.double().numpy() * _COLOUR_SCALE + 0.5) * 255).tobytes(),
        coding.to_bytes((scene.scales.double() - HOLDS.sizes.low) / HOLDS.sizes.step).tobytes(),
        words.astype("<u4").tobytes(),
        np.concatenate([first, other], axis=1).tobytes(),
    ]


def _coarse(coefficients: Array, bits: int) -> Array:
    """SH coefficients as bytes of which only the upper ``bits`` differ; 0 stays 0."""
    step = 1 << (8 - bits)
    levels = np.rint(coefficients.astype(np.float64) * 128 / step) * step + 128
    return np.clip(levels, 0, 255).astype(np.uint8)


def _from_fixed_point(parts: Array, bits: int) -> Array:
    """Positions (N, 3) from three bytes each, (N, 3, 3), lowest byte first."""
    low, middle, high = (parts[..., i].astype(np.int32) for i in range(3))
    signed = (low | middle << 8 | high << 16) << 8 >> 8  # sign extension
    return np.ldexp(signed.astype(np.float32), -bits)


def _quats_of_three(packed: Array) -> Array:
    """Version 2: x, y and z in a byte each; w is positive."""
    xyz = packed.reshape(-1, 3).astype(np.float32) / 127.5 - 1
    w = np.sqrt(np.clip(1 - np.square(xyz).sum(axis=1, keepdims=True), 0, None))
    return np.concatenate([w, xyz], axis=1)


def _quats_of_four(packed: Array) -> Array:
    """Version 3 and later: index of the largest component; nine bits and a sign for each of the
    others."""
    words = packed.view("<u4")
    levels = (
        np.stack([words >> shift & 511 for shift in (20, 10, 0)], axis=1).astype(np.float32) / 511
    )
    negative = np.stack([words >> shift & 512 for shift in (20, 10, 0)], axis=1) > 0
    others = np.where(negative, -levels, levels) * 0.5**0.5
    quats = np.empty((len(words), 4), np.float32)
    quats[:, _XYZW] = coding.from_smallest_three((words >> 30).astype(np.int64), others)
    return quats
