"""SPZ files: Niantic's compressed format, 20 bytes a Gaussian and one per SH coefficient.

Versions 2 and 3 are one gzip stream, with quaternions of three and four bytes. Version 4 has one
zstd stream per attribute. Positions are 24-bit fixed point. A file may declare its axes; without a
declaration they are not converted, as in most converters, although the format's documentation
requires right, up, back.
"""

from __future__ import annotations

import functools
import itertools
import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.scene.formats import coding, spz_levels
from pointsplat_ns.scene.formats.capacity import Capacity, Span, typical_sizes, within_colours
from pointsplat_ns.scene.formats.coding import Blocks
from pointsplat_ns.scene.formats.rounding import rounded
from pointsplat_ns.scene.formats.spz_extensions import DECLARED_AXES, records_of, turned_back
from pointsplat_ns.scene.formats.spz_values import COLOUR_SCALE, SIZES, decoded, encoded
from pointsplat_ns.scene.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.system.files import logger, require_file
from pointsplat_ns.system.progress import Progress, silent
from pointsplat_ns.system.threads import parallel_map

SPZ_VERSION = 4
"""The version that is written by default: that of the format's own library."""

FRACTION_BITS = 12
MAX_FRACTION_BITS = 23
"""Fractional bits of a position: the default, for steps of 0.00024 within 2048 units, and the
maximum. Scenes of smaller Gaussians get more, and scenes that reach farther get fewer."""

FARTHEST = 2**23 - 1
"""Largest distance of a position from the origin, in steps."""

GZIP_LEVEL = 9
ZSTD_LEVEL = 17
"""Effort of compression: of versions 2 and 3, where 6 takes a quarter of the time for 3 % more
bytes; and of version 4, which takes as long, for 6 % less than version 3. Level 12, the library's,
takes an eighth of the time for the bytes of version 3, and 19 the double for 1 or 2 % less."""

MAX_EXTENSION_BYTES = 1 << 20
"""Most bytes of extensions in versions 2 and 3, which do not declare their size."""

_MAGIC = b"NGSP"
_HEADER = struct.Struct("<4sIIBBBB")  # magic, then the fields of _Head
_HEADER_4 = 32
"""Size of the header of version 4: the common one, the start of the table (u32), and zeros."""

# flags
_ANTIALIASED = 0x01
_EXTENDED = 0x02
_LEVELS = 0x80
"""Levels of detail of Spark, only in versions 2 and 3."""


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

    @property
    def link_bytes(self) -> int:
        """Bytes of the links of Spark's tree."""
        return spz_levels.NODE_BYTES * self.count if self.flags & _LEVELS else 0


@dataclass(frozen=True)
class _Content:
    """What an SPZ file holds, decompressed."""

    head: _Head
    parts: list[bytes | memoryview]
    """Attributes, with the sizes of the header."""
    extensions: bytes | memoryview = b""
    levels: bytes | memoryview = b""
    """Links of Spark's tree."""


def read_spz(path: Path | str) -> Gaussians:
    """Read an SPZ file of version 2, 3 or 4, as :func:`~pointsplat_ns.scene.read_scene` does.

    A file that declares its axes is turned to those of a PLY. Of a file with Spark's levels of
    detail, the leaves are read. The highest band of SH degree 4, unknown extensions and unknown
    flags are ignored, and logged. Raises SceneError if the file has another format or version, is
    truncated, or declares more than it can hold.
    """
    path = require_file(path, "an SPZ file")
    with coding.damage_named(path, "SPZ"):
        return decode_spz(coding.load_bytes(path), path)


def decode_spz(data: bytes, path: Path, axes: bool = True) -> Gaussians:
    """The scene of the bytes of an SPZ file, as :func:`read_spz`. ``path`` is for messages, and
    without ``axes`` the scene keeps the axes of the file."""
    if data[:2] == b"\x1f\x8b":
        content = _from_gzip(data, path)
    elif data[:4] == _MAGIC:
        content = _from_zstd(data, path)
    else:
        raise SceneError(
            f"{path}: not an SPZ file (starts with {data[:4]!r}); expected gzip or {_MAGIC!r}"
        )
    head = content.head
    if head.degree > MAX_SH_DEGREE:
        logger.warning("%s: SH degree %d, read up to degree %d", path, head.degree, MAX_SH_DEGREE)
    parts = [np.frombuffer(part, np.uint8) for part in content.parts]
    factor = 1
    if head.flags & _LEVELS:
        mask = spz_levels.leaves(content.levels, head.count, path)
        logger.info(
            "%s: levels of detail of Spark; the %d leaves of %d nodes are read",
            path,
            mask.sum(),
            head.count,
        )
        parts = [part.reshape(head.count, -1)[mask].reshape(-1) for part in parts]
        factor = spz_levels.OPACITY_FACTOR
    scene = decoded(parts, head.rest, head.fraction_bits, factor)
    scene = turned_back(scene, records_of(content.extensions, path), path, axes)
    return scene.replace(antialiased=bool(head.flags & _ANTIALIASED))


def encode_spz(
    scene: Gaussians,
    progress: Progress = silent,
    version: int = SPZ_VERSION,
    level: int = GZIP_LEVEL,
) -> bytes:
    """Encode a scene as an SPZ file, after :func:`fitted` moved it into range.

    SH that were read from an SPZ file, or rounded for one, are unchanged. Others get 6 bits at
    degree 1 and 5 bits above, which compress better. The format's own programs use 5 and 4 bits, in
    a file a seventh smaller. Version 4 declares the axes of a PLY. Versions 2 and 3 declare none,
    because old readers refuse files with extensions.

    Args:
        scene: N Gaussians, float32 on the CPU.
        progress: called during compression.
        version: 4, 3 or 2.
        level: gzip level of versions 2 and 3, 1 to 9.

    Raises:
        SceneError: if the scene is too large for the format.
        PointSplatError: if the version is another one.
    """
    require_version(version)
    steps = 128 * scene.features_rest
    sh_bits = (8, 8) if torch.equal(steps, steps.round()) else (6, 5)
    flags = _ANTIALIASED if scene.antialiased else 0
    scene, _ = fitted(scene)
    bits = fraction_bits(scene)
    parts = encoded(scene, bits, sh_bits, quat_bytes=3 if version == 2 else 4)
    head = (_MAGIC, version, len(scene), scene.sh_degree, bits)
    if version == 4:
        return _to_zstd(head, flags, parts, progress)
    packer = zlib.compressobj(level, zlib.DEFLATED, 31)
    packed = [packer.compress(_HEADER.pack(*head, flags, 0))]
    for index, part in enumerate(parts):
        progress("compressing", index / len(parts))
        packed.append(packer.compress(part))
    return b"".join([*packed, packer.flush()])


def encoder(version: int) -> Callable[[Gaussians, Progress], bytes]:
    """:func:`encode_spz` with a version. Raises PointSplatError if there is no such version."""
    require_version(version)
    return functools.partial(encode_spz, version=version)


def version_of(path: Path) -> int:
    """Version of an SPZ file, from its header. Raises SceneError if it is none."""
    with coding.damage_named(path, "SPZ"), path.open("rb") as stream:
        start = stream.read(512)
        if start[:2] == b"\x1f\x8b":
            start = zlib.decompressobj(31).decompress(start, _HEADER.size)
        return int(_HEADER.unpack(start[: _HEADER.size])[1])


def require_version(version: int) -> None:
    """Raise a PointSplatError if a version of SPZ is not written."""
    if version not in (2, 3, 4):
        raise PointSplatError(f"SPZ version {version!r} is not written; expected 4, 3 or 2")


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
    assert CAPACITY.sh is not None
    scene = within_colours(scene, CAPACITY.colours, CAPACITY.sh)
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


CAPACITY = Capacity(
    sizes=SIZES,
    colours=Span(-0.5 / COLOUR_SCALE, 0.5 / COLOUR_SCALE, 1 / (255 * COLOUR_SCALE)),
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
    _check_flags(head, path)
    unpacked = sum(head.sizes) + head.link_bytes
    coding.require_plausible(path, unpacked, packed, head.count, head.rest)
    return head


def _check_flags(head: _Head, path: Path) -> None:
    """Log unknown flags. Raises SceneError for levels of detail in a version without them."""
    if head.version == 4 and head.flags & _LEVELS:
        raise SceneError(
            f"{path}: SPZ of version 4 with the flag of Spark's levels of detail "
            f"(0x{_LEVELS:02x}), known in versions 2 and 3; export the scene itself"
        )
    unknown = head.flags & ~(_ANTIALIASED | _EXTENDED | _LEVELS)
    if unknown:
        named = ", ".join(f"0x{1 << bit:02x}" for bit in range(8) if unknown >> bit & 1)
        logger.warning(
            "%s: flags of the SPZ file that are not known (%s) are ignored; compare the scene with "
            "what the program shows that wrote it",
            path,
            named,
        )


def _from_gzip(data: bytes, path: Path) -> _Content:
    """Versions 2 and 3. Decompresses no more than the header declares."""
    head = _head(zlib.decompressobj(31).decompress(data, _HEADER.size), (2, 3), len(data), path)
    size = _HEADER.size + sum(head.sizes) + head.link_bytes
    more = MAX_EXTENSION_BYTES if head.flags & _EXTENDED else 0
    content = zlib.decompressobj(31).decompress(data, size + more)
    blocks = Blocks(content, path, _HEADER.size)
    return _Content(
        head=head,
        parts=[blocks.take("u1", length).data for length in head.sizes],
        levels=blocks.take("u1", head.link_bytes).data,
        extensions=memoryview(content)[size:],
    )


def _from_zstd(data: bytes, path: Path) -> _Content:
    """Version 4. Decompresses no more than the header declares."""
    from zstandard import ZstdDecompressor, ZstdError

    head = _head(data, (4,), len(data), path)
    sizes = [size for size in head.sizes if size]
    # start of the table; extensions come before it
    table = int(Blocks(data, path, _HEADER.size).take("<u4", 1)[0])
    if head.streams != len(sizes) or table < _HEADER_4:
        raise SceneError(
            f"{path}: {head.streams} streams listed at byte {table}; expected {len(sizes)} from "
            f"byte {_HEADER_4} on"
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
    return _Content(
        head=head,
        parts=parts + [b""] * (len(head.sizes) - len(parts)),
        extensions=memoryview(data)[_HEADER_4:table] if head.flags & _EXTENDED else b"",
    )


def _to_zstd(
    head: tuple[bytes, int, int, int, int], flags: int, parts: list[bytes], progress: Progress
) -> bytes:
    """Version 4: the header, the declared axes, a table of packed and unpacked lengths (u64), and a
    zstd stream for each attribute that is not empty."""
    filled = [part for part in parts if part]
    streams: list[bytes] = []
    for stream in parallel_map(_zstd_stream, filled, torch.device("cpu")):
        progress("compressing", len(streams) / len(filled))
        streams.append(stream)
    table = itertools.chain.from_iterable(zip(map(len, streams), map(len, filled), strict=True))
    start = _HEADER_4 + len(DECLARED_AXES)
    return b"".join(
        [
            _HEADER.pack(*head, flags | _EXTENDED, len(filled)),
            struct.pack("<I12x", start),
            DECLARED_AXES,
            struct.pack(f"<{2 * len(filled)}Q", *table),
            *streams,
        ]
    )


def _zstd_stream(part: bytes) -> bytes:
    from zstandard import ZstdCompressor

    return ZstdCompressor(level=ZSTD_LEVEL).compress(part)
