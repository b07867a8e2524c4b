"""A zip archive of one PLY, as websites and mail send scenes; read only."""

from __future__ import annotations

import shutil
import tempfile
import zipfile
import zlib
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import one_line, require_file, require_space
from pointsplat_ns.io.formats.coding import PACKED
from pointsplat_ns.io.formats.compressed_ply import is_compressed, read_compressed_ply
from pointsplat_ns.io.ply import read_ply
from pointsplat_ns.io.ply_header import read_header


def read_zipped(path: Path | str) -> Gaussians:
    """Read the one PLY, compressed or not, in a zip archive, as :func:`~pointsplat_ns.io.read_scene` does. It is
    unpacked into a temporary folder.

    Raises:
        SceneError: if there are several PLYs, the PLY declares more bytes than its packed bytes can hold, does not fit
            on the disk, or is damaged.
    """
    path = require_file(path, "a zip archive of a PLY")
    with tempfile.TemporaryDirectory(prefix="pointsplat-") as folder:
        part = Path(folder) / "scene.ply"
        name = _unpack(path, part)
        try:
            with part.open("rb") as stream:
                compressed = is_compressed(read_header(stream, part))
            return read_compressed_ply(part) if compressed else read_ply(part)
        except SceneError as error:
            raise SceneError(str(error).replace(str(part), f"{path}: {name}")) from error


def _unpack(path: Path, part: Path) -> str:
    """Write the one PLY of an archive to a file; its name in the archive."""
    try:
        with zipfile.ZipFile(path) as archive:
            # Archives of macOS have a second entry for each file, with what its system keeps beside it.
            entries = [
                entry
                for entry in archive.infolist()
                if entry.filename.lower().endswith(".ply") and not entry.filename.rpartition("/")[2].startswith(".")
            ]
            if len(entries) != 1:
                names = ", ".join(entry.filename for entry in entries[:3])
                raise SceneError(f"{path}: {len(entries)} PLY files ({names}); expected one; unpack them")
            [entry] = entries
            if entry.file_size > max(1 << 22, PACKED * entry.compress_size):
                raise SceneError(
                    f"{path}: {entry.filename} has {entry.file_size} bytes, more than {entry.compress_size} compressed "
                    "bytes of a scene can hold"
                )
            require_space(path, part.parent, entry.file_size)
            with archive.open(entry) as packed, part.open("wb") as stream:  # no more than its size comes out
                shutil.copyfileobj(packed, stream, 1 << 20)
            return entry.filename
    except (OSError, zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError, ValueError, zlib.error) as error:
        raise SceneError(f"{path}: damaged; its PLY cannot be unpacked ({one_line(error)})") from error
