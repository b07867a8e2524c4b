"""Files as other programs write them: SPZ of version 4 with any extensions, and SOG folders."""

import gzip
import io
import struct
import zipfile
from pathlib import Path

import zstandard

from pointsplat_ns.scene.formats.sog import encode_sog
from pointsplat_ns.scene.formats.spz import encode_spz
from pointsplat_ns.scene.gaussians import Gaussians


def encode_spz4(scene: Gaussians, extensions: bytes = b"") -> bytes:
    """The bytes of a file of version 4: what one of version 3 holds, with a stream for each
    attribute."""
    content = gzip.decompress(encode_spz(scene, version=3))
    magic, _, n, degree, bits, flags, _ = struct.unpack_from("<4sIIBBBB", content)
    sizes = [size * n for size in (9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)) if size]
    starts = [16 + sum(sizes[:i]) for i in range(len(sizes))]
    parts = [content[start : start + size] for start, size in zip(starts, sizes, strict=True)]
    streams = [zstandard.ZstdCompressor().compress(part) for part in parts]
    head = struct.pack(
        "<4sIIBBBB", magic, 4, n, degree, bits, flags | 2 * bool(extensions), len(parts)
    )
    table = b"".join(
        struct.pack("<QQ", len(s), len(p)) for s, p in zip(streams, parts, strict=True)
    )
    return b"".join([head, struct.pack("<I12x", 32 + len(extensions)), extensions, table, *streams])


def write_sog_folder(scene: Gaussians, folder: Path) -> None:
    """Unpack what a ``.sog`` file of a scene holds."""
    with zipfile.ZipFile(io.BytesIO(encode_sog(scene))) as archive:
        archive.extractall(folder)
