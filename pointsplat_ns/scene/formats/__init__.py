"""Scene file formats: the table of all formats, and a module for each except plain PLY.

One table identifies every file. The first bytes, or for a zip archive the names of its files,
decide the format, whatever the file is called. Only ``.splat`` has no magic number and is
identified by name. Readers check counts and sizes against the file size before they allocate
memory, and limit decompression.
"""

from __future__ import annotations

import fnmatch
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.checkpoints import checkpoint_parts, read_checkpoint
from pointsplat_ns.scene.formats import gltf, sog, splat, spz
from pointsplat_ns.scene.formats.capacity import Capacity
from pointsplat_ns.scene.formats.compressed_ply import is_compressed, read_compressed_ply
from pointsplat_ns.scene.formats.gltf import encode_glb, encode_gltf, encode_spz_glb, read_gltf
from pointsplat_ns.scene.formats.rad import MAGIC as RAD_MAGIC
from pointsplat_ns.scene.formats.rad import PAGE_MAGIC as RAD_PAGE
from pointsplat_ns.scene.formats.rad import rad_parts, read_rad
from pointsplat_ns.scene.formats.sog import encode_sog, read_sog, rounded_for_sog
from pointsplat_ns.scene.formats.sog_images import SOG_META
from pointsplat_ns.scene.formats.sog_stream import STREAM_META, read_sog_stream
from pointsplat_ns.scene.formats.splat import encode_splat, read_splat
from pointsplat_ns.scene.formats.spz import SPZ_VERSION, encode_spz, read_spz, rounded_for_spz
from pointsplat_ns.scene.formats.tileset import TILESET, read_tileset, tileset_parts
from pointsplat_ns.scene.gaussians import Gaussians, Traits
from pointsplat_ns.scene.ply import ply_bytes, read_ply, write_ply
from pointsplat_ns.scene.ply_header import read_header
from pointsplat_ns.system.files import failure_named, one_line, replacing
from pointsplat_ns.system.opening import open_regular
from pointsplat_ns.system.progress import Progress


@dataclass(frozen=True)
class Format:
    """A kind of scene file."""

    name: str
    suffix: str
    """Suffix of its file names, lower case, or a whole name; empty for a format that is identified
    only by content."""
    read: Callable[[Path], Gaussians] | None = None
    write: Callable[[Gaussians, Path, Progress], None] | None = None
    starts: tuple[bytes, ...] = ()
    """Magic numbers at the start of its files, if they identify it."""
    zip_member: str = ""
    """Pattern of a file name, without folders, in its zip archives, if that identifies it."""
    instead: str = ""
    """Advice to the user, for a format that is not read."""
    bytes_of: Callable[[int, int, Traits], int] | None = None
    """Exact file size, bytes, from the number of Gaussians, their SH degree and the scene's traits;
    None if it depends on more."""
    encode: Callable[[Gaussians, Progress], bytes] | None = None
    """Encodes a scene, where only the encoded bytes give the file size."""
    rounded: Callable[[Gaussians, float], Gaussians] | None = None
    """Rounds a scene's numbers to make its file smaller, by a tolerance (see :mod:`rounding`)."""
    parts: Callable[[Path], list[Path]] | None = None
    """All files of a scene, the named one first, if it may have others beside it."""
    capacity: Capacity = Capacity()
    """Range and step of each attribute in its files."""
    written_by: str = ""
    """The command that writes its files, if it is another one than those that write a scene."""
    up: str = ""
    """The up axis of all its files, if the format has one."""


def _writer(
    encode: Callable[[Gaussians, Progress], bytes],
) -> Callable[[Gaussians, Path, Progress], None]:
    """A function that encodes a scene and writes it to a file atomically."""

    def write(scene: Gaussians, path: Path, progress: Progress) -> None:
        data = encode(scene, progress)
        with replacing(path, len(data)) as part:
            part.write_bytes(data)

    return write


_PLY = (b"ply\n", b"ply\r")
_CONVERT = (
    "convert it to .ply or .sog with splat-transform, or open it in SuperSplat and export the scene"
)
_EXPORT = "export the scene as .ply, .sog, .spz or .glb from the program that made it"

FORMATS = (
    # Longer suffixes come before the suffixes that they end with, and names that occur in several
    # formats after names that occur in one.
    Format("compressed PLY", ".compressed.ply", read_compressed_ply, starts=_PLY),
    Format(
        "3DGS PLY",
        ".ply",
        read_ply,
        lambda scene, path, _: write_ply(scene, path),
        _PLY,
        bytes_of=ply_bytes,
        capacity=Capacity(offset=True),
    ),
    Format(
        "SPZ",
        ".spz",
        read_spz,
        _writer(encode_spz),
        (b"\x1f\x8b\x08", b"NGSP"),
        encode=encode_spz,
        rounded=rounded_for_spz,
        capacity=spz.CAPACITY,
    ),
    Format(
        "SuperSplat project",
        ".ssproj",
        zip_member="document.json",
        instead="open it in SuperSplat and export the scene as .ply, .sog or .spz",
    ),
    Format(
        "zip of a streamed SOG", "", zip_member=STREAM_META, instead="unpack it and name its folder"
    ),
    Format(
        "SOG",
        ".sog",
        read_sog,
        _writer(encode_sog),
        zip_member=SOG_META,
        encode=encode_sog,
        rounded=rounded_for_sog,
        capacity=sog.CAPACITY,
    ),
    Format(
        "checkpoint",
        ".ckpt",
        read_checkpoint,
        starts=(b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P",),
        zip_member="data.pkl",
        parts=checkpoint_parts,
    ),
    Format(
        "streamed SOG",
        STREAM_META,
        read_sog_stream,
        capacity=sog.CAPACITY,
        written_by="pointsplat lod SCENE --stream",
    ),
    Format("SOG folder", SOG_META, read_sog),
    Format(
        "splat",
        ".splat",
        read_splat,
        _writer(encode_splat),
        bytes_of=lambda count, *_: 32 * count,
        capacity=splat.CAPACITY,
    ),
    Format(
        "glTF with SPZ",
        ".spz.glb",
        read_gltf,
        _writer(encode_spz_glb),
        encode=encode_spz_glb,
        rounded=rounded_for_spz,
        capacity=gltf.CAPACITY_SPZ,
        up="y",
    ),
    Format(
        "glTF",
        ".glb",
        read_gltf,
        _writer(encode_glb),
        starts=(b"glTF",),
        bytes_of=gltf.glb_bytes,
        capacity=gltf.CAPACITY,
        up="y",
    ),
    Format(
        "glTF",
        ".gltf",
        read_gltf,
        _writer(encode_gltf),
        bytes_of=gltf.gltf_bytes,
        parts=gltf.gltf_parts,
        capacity=gltf.CAPACITY,
        up="y",
    ),
    Format("zip of a PLY", "", zip_member="*.ply", instead="unpack it and name the PLY"),
    Format("ksplat", ".ksplat", instead=_CONVERT),
    Format("moving scene (splatv)", ".splatv", instead="export a .ply of one moment"),
    Format("LCC", ".lcc", instead=_CONVERT),
    Format("LCC", ".lcc2", instead=_CONVERT),
    Format("Postshot project", ".psht", instead=_EXPORT),
    Format(
        "RAD",
        ".rad",
        read_rad,
        starts=(RAD_MAGIC,),
        parts=rad_parts,
        capacity=Capacity(antialiased=False, offset=True),
        written_by="pointsplat lod SCENE -o room.rad",
    ),
    Format("page of a RAD", ".radc", starts=(RAD_PAGE,), instead="name its .rad"),
    Format(
        "3D Tiles",
        TILESET,
        read_tileset,
        parts=tileset_parts,
        capacity=gltf.CAPACITY_SPZ,
        written_by="pointsplat lod SCENE --tiles",
    ),
    Format("USD", ".usdz", starts=(b"PXR-USDC", b"#usda"), zip_member="*.usd[ac]", instead=_EXPORT),
    Format(
        "LAS point cloud", ".las", starts=(b"LASF",), instead="it contains points, no Gaussians"
    ),
    Format(
        "E57 point cloud", ".e57", starts=(b"ASTM-E57",), instead="it contains points, no Gaussians"
    ),
    Format(
        "Git LFS pointer",
        "",
        starts=(b"version https://git-lfs",),
        instead="fetch the file with git lfs pull",
    ),
    Format(
        "web page",
        "",
        starts=(b"<!DOCTYPE", b"<!doctype", b"<html"),
        instead="download the file again",
    ),
)
"""All formats of files that hold only a scene, and the formats that are refused by name."""

READABLE = ", ".join(
    kind.suffix for kind in FORMATS if kind.read and kind.suffix not in ("", ".ckpt")
)
WRITABLE = ", ".join(kind.suffix for kind in FORMATS if kind.write)


def format_named(name: str) -> Format | None:
    """The format of a file name or a suffix such as ``.spz``; None if no format has it."""
    name = Path(name).name.lower()
    ends = (kind for kind in FORMATS if kind.suffix and name.endswith(kind.suffix))
    return next((kind for kind in ends if kind.suffix.startswith(".") or name == kind.suffix), None)


def format_to_read(path: Path) -> Format | None:
    """The format of a file, or of a folder of SOG, streamed or not, or of 3D Tiles: by content, or
    else by name. None if both are unknown. Raises SceneError if the file cannot be read, or its
    format is known but not supported."""
    if path.is_dir():
        return next(
            (
                format_named(name)
                for name in (STREAM_META, SOG_META, TILESET)
                if (path / name).is_file()
            ),
            None,
        )
    with failure_named(path, "read"):
        with open_regular(path) as stream:
            start = stream.read(64)
        kind = _told_by_content(path, start) or format_named(path.name)
    if kind is not None and kind.read is None:
        raise SceneError(f"{path}: {kind.name} files are not read; {kind.instead}")
    return kind


def _told_by_content(path: Path, start: bytes) -> Format | None:
    """The format identified by a file's content, from its first bytes; None if none matches."""
    if start.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _told_by_zip(path)
    kind = next((kind for kind in FORMATS if start.startswith(kind.starts)), None)
    if kind is not None and kind.read is read_gltf:
        return format_named(".spz.glb") if gltf.has_spz(path) else kind
    if kind is not None and kind.starts == _PLY:
        compressed, plain = FORMATS[:2]
        with suppress(SceneError), open_regular(path) as stream:
            return compressed if is_compressed(read_header(stream, path)) else plain
        return plain  # its reader reports the damaged header
    return kind


def _told_by_zip(path: Path) -> Format | None:
    """The format identified by the file names in a zip archive. None if the archive has no end and
    the file has the suffix of a format that is an archive. Raises SceneError if no format
    matches."""
    named = format_named(path.name)
    try:
        with open_regular(path) as stream, zipfile.ZipFile(stream) as archive:
            names = archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError, RuntimeError) as error:
        if named is not None and named.zip_member:
            return None
        raise SceneError(
            f"{path}: a truncated or damaged zip archive ({one_line(error)})"
        ) from error
    files = [name.rpartition("/")[2].lower() for name in names]
    packed = next(
        (kind for kind in FORMATS if kind.zip_member and fnmatch.filter(files, kind.zip_member)),
        None,
    )
    if packed is None:
        found = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
        raise SceneError(
            f"{path}: a zip archive of {found or 'nothing'}; expected a SOG or a checkpoint"
        )
    return packed


def format_to_write(path: Path | str, spz_version: int = SPZ_VERSION) -> Format:
    """The format of an output path, SPZ in the given version. Raises SceneError if no writable
    format has its suffix, and PointSplatError if SPZ is not written in that version."""
    spz.require_version(spz_version)
    path = Path(path)
    kind = format_named(path.name)
    if kind is None or kind.write is None:
        what = f"a {kind.name} file" if kind else f"a {path.suffix or 'nameless'} file"
        if kind is not None and kind.written_by:
            raise SceneError(f"{path}: cannot write {what} here; use `{kind.written_by}`")
        raise SceneError(f"{path}: cannot write {what}; expected a name that ends in {WRITABLE}")
    if kind.read is read_spz and spz_version != SPZ_VERSION:
        encode = spz.encoder(spz_version)
        return replace(kind, write=_writer(encode), encode=encode)
    return kind


def format_like(path: Path) -> Format:
    """The output format for a scene derived from another file: that file's format if it can be
    written, SOG for a SOG folder and a compressed PLY, else PLY."""
    if path.is_file() or path.is_dir():
        with suppress(SceneError):  # its reader reports an unreadable file
            kind = format_to_read(path)
            if kind is not None and kind.read in (read_compressed_ply, read_sog):
                return format_to_write(".sog")  # similar file size
            if kind is not None and kind.write is not None:
                return kind
    return format_to_write(".ply")
