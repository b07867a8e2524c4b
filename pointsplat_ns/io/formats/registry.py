"""The formats of scene files: which there are, and which one a path means."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians, Traits
from pointsplat_ns.io.files import replacing
from pointsplat_ns.io.formats.coding import morton_order
from pointsplat_ns.io.formats.compressed_ply import (
    compressed_ply_bytes,
    encode_compressed_ply,
    is_compressed,
    read_compressed_ply,
)
from pointsplat_ns.io.formats.glb import encode_glb, glb_bytes, read_glb
from pointsplat_ns.io.formats.ksplat import read_ksplat
from pointsplat_ns.io.formats.rounding import Rounding
from pointsplat_ns.io.formats.sog import encode_sog, read_sog, rounded_for_sog, write_sog_folder
from pointsplat_ns.io.formats.sog_images import META
from pointsplat_ns.io.formats.sog_stream import STREAM_META, read_sog_stream
from pointsplat_ns.io.formats.splat import drawing_order, encode_splat, read_splat, splat_bytes
from pointsplat_ns.io.formats.spz import encode_spz, read_spz, rounded_for_spz
from pointsplat_ns.io.ply import ply_bytes, read_ply, write_ply
from pointsplat_ns.io.ply_header import read_header
from pointsplat_ns.system.progress import Progress

Writer = Callable[[Gaussians, Path, Progress], None]


@dataclass(frozen=True)
class Format:
    """A kind of scene file."""

    name: str
    suffix: str
    """The end of its files' names, lower case."""
    read: Callable[[Path], Gaussians] | None = None
    write: Writer | None = None
    starts: tuple[bytes, ...] = ()
    """What its files begin with, if that tells."""
    bytes_of: Callable[[int, int, Traits], int] | None = None
    """Exact size of a file, bytes, by the number of Gaussians, their SH degree, and the scene's traits; None
    if it depends on more."""
    encode: Callable[[Gaussians, Progress], bytes] | None = None
    """The bytes of a file of a scene, where only they tell its size."""
    rounded: Callable[[Gaussians, Rounding], Gaussians] | None = None
    """A scene whose numbers are rounded, so that a file of it is smaller."""
    holds_antialiased: bool = True
    """Whether a file says that a scene was trained with antialiasing."""
    order: Callable[[Gaussians], Tensor] | None = None
    """Indices (N,) of a scene's Gaussians in the order in which they are written, if that is another."""

    @property
    def budget_suffix(self) -> str:
        """Suffix of a size in a budget, such as ``.spz`` in 5MB.spz."""
        return self.suffix if self.suffix.startswith(".") else ".sog"

    def fits(self, path: Path) -> bool:
        """Whether a file's name is one of this format."""
        name = path.name.lower()
        return name.endswith(self.suffix) if self.suffix.startswith(".") else name == self.suffix


def _writer(encode: Callable[[Gaussians, Progress], bytes]) -> Writer:
    """A function that writes encoded bytes to a file, whole or not at all."""

    def write(scene: Gaussians, path: Path, progress: Progress) -> None:
        data = encode(scene, progress)
        with replacing(path, len(data)) as part:
            part.write_bytes(data)

    return write


def _read_any_ply(path: Path) -> Gaussians:
    """Read a PLY, which its header tells to be compressed or not."""
    with path.open("rb") as stream:
        header = read_header(stream, path)
    return read_compressed_ply(path) if is_compressed(header) else read_ply(path)


FORMATS = (
    # Longer ends of names come before those that they end with.
    Format(
        "compressed PLY", ".compressed.ply", _read_any_ply, _writer(encode_compressed_ply), (b"ply\n", b"ply\r"),
        compressed_ply_bytes, order=morton_order,
    ),
    Format(
        "3DGS PLY", ".ply", _read_any_ply, lambda scene, path, _: write_ply(scene, path), (b"ply\n", b"ply\r"),
        ply_bytes,
    ),
    Format(
        "SPZ", ".spz", read_spz, _writer(encode_spz), (b"\x1f\x8b", b"NGSP"), encode=encode_spz, rounded=rounded_for_spz
    ),
    Format(
        "SOG", ".sog", read_sog, _writer(encode_sog), (b"PK\x03\x04",), encode=encode_sog, rounded=rounded_for_sog,
        order=morton_order,
    ),
    Format("streamed SOG", STREAM_META, read_sog_stream),
    Format(
        "SOG folder", META, read_sog, write_sog_folder, encode=encode_sog, rounded=rounded_for_sog, order=morton_order
    ),
    Format("ksplat", ".ksplat", read_ksplat),
    Format(
        "splat", ".splat", read_splat, _writer(encode_splat), bytes_of=splat_bytes,
        holds_antialiased=False, order=drawing_order,
    ),
    Format("glTF", ".glb", read_glb, _writer(encode_glb), (b"glTF",), glb_bytes, holds_antialiased=False),
    Format("LCC", ".lcc"), Format("LCC", ".lcc2"),
)  # fmt: skip
"""All formats of files that hold nothing but a scene."""

READABLE = ", ".join(kind.suffix for kind in FORMATS if kind.read)
WRITABLE = ", ".join(kind.suffix for kind in FORMATS if kind.write)


def format_named(name: str) -> Format | None:
    """The format that the end of a file's name means, such as ``.spz``; None if there is none."""
    return next((kind for kind in FORMATS if kind.fits(Path(name))), None)


def format_to_read(path: Path) -> Format | None:
    """The format of a file or SOG folder, streamed or not, by its first bytes, else by its name; None if neither is
    known. Raises SceneError if the file cannot be read, or its format is known and not read."""
    if path.is_dir():
        return next((format_named(name) for name in (STREAM_META, META) if (path / name).is_file()), None)
    named = format_named(path.name)
    try:
        with path.open("rb") as stream:
            start = stream.read(8)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror})") from error
    if named is None or named.starts and not start.startswith(named.starts):
        named = next((kind for kind in FORMATS if kind.starts and start.startswith(kind.starts)), named)
    if named is not None and named.read is None:
        raise SceneError(f"{path}: {named.name} files are not read; expected one of {READABLE}")
    return named


def format_name(path: Path) -> str:
    """Name of the format of a file or SOG folder that can be read; a PLY's is that of its header, not of its name.
    Raises SceneError as :func:`format_to_read`, or if a PLY's header is damaged."""
    kind = format_to_read(path)
    if kind is None:
        return "Splatfacto checkpoint"
    if kind.read is not _read_any_ply:
        return kind.name
    with path.open("rb") as stream:
        return FORMATS[0 if is_compressed(read_header(stream, path)) else 1].name


def format_to_write(path: Path | str) -> Format:
    """The format that a name asks for; a SceneError if no format that is written has such a name."""
    path = Path(path)
    kind = format_named(path.name)
    if kind is None or kind.write is None:
        what = f"a {kind.name} file" if kind else f"a {path.suffix or 'nameless'} file"
        raise SceneError(f"{path}: cannot write {what}; expected a name that ends in {WRITABLE}")
    return kind


def format_like(path: Path) -> Format:
    """The format to write what is made of a scene: that of the scene's file if it can be written, else PLY."""
    kind = format_named(path.name)
    if path.is_dir() or kind is None or kind.write is None:
        return format_to_write(".ply")
    if kind.suffix == ".ply":
        with suppress(SceneError, OSError), path.open("rb") as stream:
            if is_compressed(read_header(stream, path)):
                return format_to_write(".compressed.ply")
    return kind
