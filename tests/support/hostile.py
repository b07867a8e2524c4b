"""Files that harm a reader that trusts them."""

import io
import pickle
import struct
import zipfile
import zlib

POSTSCRIPT = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 64 48
%%EndComments
(/etc/passwd) (r) file
showpage
"""
"""An image that Pillow hands to Ghostscript, whatever its name."""


def png_of(width: int, height: int) -> bytes:
    """A PNG that ends behind its header."""
    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    data = struct.pack(">I", 1000) + b"IDAT"
    return (
        b"\x89PNG\r\n\x1a\n"
        + struct.pack(">I", 13)
        + head
        + struct.pack(">I", zlib.crc32(head))
        + data
    )


def webp_of(width: int, height: int) -> bytes:
    """A WebP that ends behind its header."""
    bits = (width - 1) | (height - 1) << 14
    body = b"WEBPVP8L" + struct.pack("<I", 1 << 16) + b"\x2f" + struct.pack("<I", bits) + bytes(99)
    return b"RIFF" + struct.pack("<I", len(body)) + body


class Called:
    """Pickled as a call of a function that a name of a module has."""

    def __init__(self, name: str, *arguments: object):
        self.name = name
        self.arguments = arguments


class _Pickler(pickle._Pickler):
    """Writes a :class:`Called` without the function, which need not exist."""

    def save(self, value, save_persistent_id=True):  # type: ignore[override]
        if isinstance(value, Called):
            module, _, name = value.name.rpartition(".")
            self.write(pickle.GLOBAL + f"{module}\n{name}\n".encode())
            self.save(value.arguments)
            self.write(pickle.REDUCE)
        else:
            super().save(value, save_persistent_id)


def pickled(value: object) -> bytes:
    """A value as torch pickles it."""
    stream = io.BytesIO()
    _Pickler(stream, 2).dump(value)
    return stream.getvalue()


def archive_of(data: bytes) -> bytes:
    """The archive that torch writes, of a pickle."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        archive.writestr("archive/data.pkl", data)
        archive.writestr("archive/version", "3\n")
        archive.writestr("archive/byteorder", "little")
    return stream.getvalue()
