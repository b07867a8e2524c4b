"""``.ksplat`` files of mkkellogg's viewer, read only.

A header, a header for each section, and in each section rows of one length. At compression 1 and 2, positions are
16-bit numbers about the centre of a bucket of Gaussians, sizes and quaternions are half precision, and SH are half
precision or bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.io.files import require_file, require_memory
from pointsplat_ns.io.formats.coding import (
    Array,
    Blocks,
    damage_named,
    dc_of_shares,
    load_bytes,
    log_of_sizes,
    logits_of_bytes,
    scene_of,
)
from pointsplat_ns.io.formats.holding import Holds, Span
from pointsplat_ns.io.usable import keep_usable

_HEADER, _SECTION = 4096, 1024
_TYPES = {"means": ("<f4", "<u2", "<u2"), "floats": ("<f4", "<f2", "<f2"), "sh": ("<f4", "<f2", "u1")}
"""Types of numbers by compression, 0 to 2."""

_HALF = "float32 or float16"

HOLDS = Holds(
    positions=Span(how="float32 or 16 bits about centres"),
    sizes=Span(how=_HALF),
    colours=Span(-0.5 / SH_C0, 0.5 / SH_C0, 1 / (255 * SH_C0)),
    opacities=Span(0.0, 1.0, 1 / 255),
    rotations=Span(-1.0, 1.0, how=_HALF),
    sh=Span(how=f"up to degree 2; {_HALF} or 8 bits"),
    antialiased=False,
)


@dataclass(frozen=True)
class _Section:
    count: int
    capacity: int
    """Rows that there is room for."""
    bucket_size: int
    buckets: int
    block_size: float
    bucket_bytes: int
    steps: int
    full: int
    partial: int
    degree: int

    @property
    def rest(self) -> int:
        return (self.degree + 1) ** 2 - 1


def read_ksplat(path: Path | str) -> Gaussians:
    """Read a ``.ksplat`` file of any compression, 0 to 2, and SH degree, 0 to 2, as
    :func:`~pointsplat_ns.io.read_scene` does. Sections of fewer SH get zeros. Raises SceneError if the file is of
    another kind, is truncated, or declares more than it can hold."""
    path = require_file(path, "a .ksplat file")
    with damage_named(path, ".ksplat"):
        require_memory(path, 3 * path.stat().st_size)
        data = load_bytes(path)
        if len(data) < _HEADER:
            raise SceneError(f"{path}: truncated; a .ksplat header has {_HEADER} bytes, found {len(data)}")
        major, minor, room, total, compression = struct.unpack_from("<BB2xI8xIH", data)
        if major != 0 or minor < 1 or compression > 2:
            raise SceneError(
                f"{path}: .ksplat of version {major}.{minor}, compression {compression}; expected 0.1 and 0 to 2"
            )
        if _HEADER + room * _SECTION > len(data):
            raise SceneError(f"{path}: truncated; {room} sections declared in {len(data)} bytes")
        sections = [_section(data, index, compression, path) for index in range(room)]
        if sum(section.count for section in sections) != total:
            found = sum(section.count for section in sections)
            raise SceneError(f"{path}: {total} Gaussians declared, {found} in its sections")
        low, high = struct.unpack_from("<ff", data, 36)
        # Where the header names no range, SH of compression 2 lie within 1.5.
        bounds = (low or -1.5, high or 1.5)
        rest = max((section.rest for section in sections), default=0)
        require_memory(path, 2 * 4 * total * (14 + 3 * rest))
        blocks = Blocks(data, path, _HEADER + room * _SECTION)
        scenes = [_decode(section, blocks, compression, bounds, rest, path) for section in sections]
        scene = Gaussians.cat(scenes) if scenes else Gaussians.empty()
    return keep_usable(scene, path)


def _section(data: bytes, index: int, compression: int, path: Path) -> _Section:
    count, capacity, size, buckets, block, stored, steps, full, partial, degree = struct.unpack_from(
        "<IIIIfH2xI4xIIH", data, _HEADER + index * _SECTION
    )
    if degree > 2 or count > capacity:
        raise SceneError(
            f"{path}: a section of SH degree {degree} with {count} of {capacity} Gaussians; expected degree 0 to 2"
        )
    if compression and (buckets != full + partial or full * size > count or stored != 12):
        raise SceneError(
            f"{path}: {buckets} buckets of {stored} bytes, {full} full and {partial} partly; expected 12 bytes each"
        )
    return _Section(
        count, capacity, size, buckets, block, stored, steps or (32767 if compression else 1), full, partial, degree
    )


def _decode(
    section: _Section, blocks: Blocks, compression: int, bounds: tuple[float, float], rest: int, path: Path
) -> Gaussians:
    lengths = blocks.take("<u4", section.partial)
    stored = blocks.take("u1", section.buckets, section.bucket_bytes)
    row = np.dtype(
        [
            ("means", _TYPES["means"][compression], 3),
            ("stds", _TYPES["floats"][compression], 3),
            ("quats", _TYPES["floats"][compression], 4),
            ("rgba", "u1", 4),
            ("sh", _TYPES["sh"][compression], (3 * section.rest,)),
        ]
    )
    rows = blocks.take(row, section.capacity)[: section.count]
    means = rows["means"].astype(np.float64)
    if compression and section.count:
        left, partial = section.count - section.full * section.bucket_size, lengths.astype(np.int64)
        if int(partial.sum()) != left:
            raise SceneError(f"{path}: {int(partial.sum())} Gaussians in partly filled buckets; expected {left}")
        filled = np.concatenate([np.full(section.full, section.bucket_size, np.int64), partial])
        of = np.repeat(np.arange(section.buckets), filled)
        centres = stored.copy().view("<f4")
        means = (means - section.steps) * (section.block_size / 2 / section.steps) + centres[of]
    sh = rows["sh"].astype(np.float64)
    if compression == 2:
        sh = bounds[0] + sh / 255 * (bounds[1] - bounds[0])
    return scene_of(
        means,
        log_of_sizes(rows["stds"].astype(np.float32)),
        rows["quats"].astype(np.float32),
        logits_of_bytes(rows["rgba"][:, 3]),
        dc_of_shares(rows["rgba"][:, :3].astype(np.float32) / 255),
        _coefficients(sh, section.degree, rest),
    )


def _coefficients(sh: Array, degree: int, rest: int) -> Array:
    """(N, rest, 3) of numbers band by band, and in each band all of red, then green, then blue."""
    out = np.zeros((len(sh), rest, 3), np.float32)
    start = 0
    for band in range(1, degree + 1):
        size, first = 2 * band + 1, band**2 - 1
        part = sh[:, start : start + 3 * size].reshape(len(sh), 3, size)
        out[:, first : first + size] = part.transpose(0, 2, 1)
        start += 3 * size
    return out
