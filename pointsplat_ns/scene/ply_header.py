"""Parses the header of a PLY file, within a limited length.

The header is parsed before memory is allocated for the data, so that a damaged or hostile header (a
count of 10^15, or no end) does no harm. Readers check its counts against the file size.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.transforms import AXES, Direction
from pointsplat_ns.scene.gaussians import Traits, is_direction
from pointsplat_ns.scene.offsets import OFFSET_COMMENT, offset_of_text, offset_text
from pointsplat_ns.system.files import logger

_TYPES = {
    "char": "int8",
    "int8": "int8",
    "uchar": "uint8",
    "uint8": "uint8",
    "short": "int16",
    "int16": "int16",
    "ushort": "uint16",
    "uint16": "uint16",
    "int": "int32",
    "int32": "int32",
    "uint": "uint32",
    "uint32": "uint32",
    "float": "float32",
    "float32": "float32",
    "double": "float64",
    "float64": "float64",
}
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Element:
    """One element of a PLY file."""

    name: str
    count: int
    properties: tuple[tuple[str, str], ...]
    """``(name, type)`` in the file's order. A type is a name that PLY and numpy share
    (``float32``), or for a list ``list uint8 int32``."""

    @property
    def lists(self) -> tuple[str, ...]:
        """Names of the list properties."""
        return tuple(name for name, kind in self.properties if kind.startswith("list"))

    @property
    def row_bytes(self) -> int:
        """Bytes of one binary row, if no property is a list."""
        return sum(np.dtype(kind).itemsize for _, kind in self.properties)


@dataclass(frozen=True)
class Header:
    """A parsed PLY header."""

    order: str
    """``"<"``, ``">"``, or empty for an ASCII file."""
    elements: tuple[Element, ...]
    size: int
    """Length of the header, bytes: offset of the data."""
    comments: tuple[str, ...] = ()
    """Text of the comments."""

    def before(self, name: str) -> tuple[Element, ...]:
        """The elements before the element ``name``."""
        return self.elements[: [element.name for element in self.elements].index(name)]

    def up_to(self, name: str) -> bytes:
        """The header as ASCII bytes, without comments, through the element ``name``."""
        form = next(form for form, order in _ORDERS.items() if order == self.order)
        lines = ["ply", f"format {form} 1.0"]
        for element in self.elements[: len(self.before(name)) + 1]:
            lines.append(f"element {element.name} {element.count}")
            lines += [f"property {kind} {prop}" for prop, kind in element.properties]
        return "\n".join([*lines, "end_header", ""]).encode("ascii", "backslashreplace")


def read_header(stream: BinaryIO, path: Path) -> Header:
    """Parse the header at the start of ``stream``, which is left at an unspecified position. Vertex
    properties get 3DGS names, without prefixes. Raises SceneError if it is not a PLY header, does
    not end, or has an invalid line."""
    text, size = _header_text(stream, path)
    order: str | None = None
    elements: list[tuple[str, int, list[tuple[str, str]]]] = []
    comments = tuple(
        line.partition(" ")[2].strip() for line in text[1:] if line.startswith("comment ")
    )
    for number, line in enumerate(text[1:], start=2):
        match line.split():
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", form, "1.0"] if form in _ORDERS:
                order = _ORDERS[form]
            case ["element", name, count] if count.isascii() and count.isdigit():
                # More than 18 digits exceed the size of every file, also when truncated to 18.
                elements.append((name, int(count[:19]), []))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name, _TYPES[kind]))
            case ["property", "list", count, kind, name] if (
                elements and {count, kind} <= _TYPES.keys()
            ):
                elements[-1][2].append((name, f"list {_TYPES[count]} {_TYPES[kind]}"))
            case _:
                raise SceneError(
                    f"{path}: PLY header line {number} is not understood: {line[:80]!r}"
                )
    if order is None:
        raise SceneError(
            f"{path}: PLY header names no format; expected ascii, binary_little_endian or "
            "_big_endian"
        )
    _reject_duplicates([name for name, _, _ in elements], "element", path)
    for name, _, properties in elements:
        _reject_duplicates([prop for prop, _ in properties], f"{name} property", path)
        names = {prop for prop, _ in properties}
        # CloudCompare's prefixes
        prefixed = r"(?:scalar_)?(?:scal_)?(f_dc_\d|f_rest_\d+|opacity|scale_\d|rot_\d|filter_3D)"
        for index, (prop, kind) in enumerate(properties):
            found = re.fullmatch(prefixed, prop) if name == "vertex" else None
            if found and found[1] not in names:  # unless the plain name exists
                names.add(found[1])
                properties[index] = found[1], kind
    return Header(
        order,
        tuple(Element(name, count, tuple(props)) for name, count, props in elements),
        size,
        comments,
    )


def first_lines(traits: Traits) -> list[str]:
    """The header lines before the elements, with comments for :func:`traits_of`."""
    comments = ["SplatRenderMode: mip"] * traits.antialiased
    if traits.up is not None:
        up = traits.up if isinstance(traits.up, str) else " ".join(map(repr, traits.up))
        comments.append(f"Vertical Axis: {up}")
    if traits.offset is not None:
        comments.append(OFFSET_COMMENT + offset_text(traits.offset))
    return [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
    ]


def traits_of(header: Header, path: Path) -> Traits:
    """The traits that a header's comments declare; the last comment on each wins. Rendering modes
    other than ordinary and antialiased are logged as a warning.

    Brush and splat-transform write ``SplatRenderMode: default``, ``mip`` or ``2dgs``, Postshot
    ``antialiased 0`` or ``1``, nerfstudio ``Vertical Axis: z``, Brush ``Vertical axis: y`` or three
    numbers.
    """
    found = False
    up = None
    offset = None
    by_brush = "exported from brush" in (comment.lower() for comment in header.comments)
    for comment in header.comments:
        words = comment.lower().replace(":", " ").split()
        if words[:1] == ["splatrendermode"] and len(words) > 1:
            found = words[1] == "mip"
            if words[1] not in ("default", "mip"):
                logger.warning(
                    "%s: trained for %r rendering; drawn here as ordinary Gaussians", path, words[1]
                )
        elif words[:1] == ["antialiased"] and words[1:] in (["0"], ["1"]):
            found = words[1] == "1"
        elif words[:2] == ["vertical", "axis"]:
            up = _up_of(words[2:], by_brush) or up
        elif comment.startswith(OFFSET_COMMENT):  # three numbers to add to x, y and z
            offset = offset_of_text(comment.removeprefix(OFFSET_COMMENT))
            if offset is None:
                logger.warning(
                    "%s: no offset of three numbers in the comment %r", path, comment[:80]
                )
    return Traits(found, up, offset)


def _up_of(words: list[str], by_brush: bool) -> str | Direction | None:
    """The up direction of a comment on the vertical axis: an axis or three numbers; None if it is
    neither. Brush writes "y" into every file whose cameras it does not know, and means -y."""
    if len(words) == 1 and words[0].removeprefix("+") in AXES:
        axis = words[0].removeprefix("+")
        return "-y" if by_brush and axis == "y" else axis
    try:
        numbers = tuple(
            float(word) for word in " ".join(words).strip("[]").replace(",", " ").split()
        )
    except ValueError:
        return None
    if not is_direction(numbers):
        return None
    x, y, z = numbers
    along = [axis for axis, number in zip("xyz", numbers, strict=True) if number]
    return (x, y, z) if len(along) > 1 else ("-" if x + y + z < 0 else "") + along[0]


def _header_text(stream: BinaryIO, path: Path) -> tuple[list[str], int]:
    """Lines of the header up to ``end_header``, and their length in bytes."""
    # a 3DGS header has about 1.5 kB, with comments less than a thousand times as much
    most = 1 << 20
    start = stream.read(most)
    if start[:4] not in (b"ply\n", b"ply\r"):
        raise SceneError(
            f"{path}: not a PLY file (starts with {start[:4]!r}); expected the line 'ply'"
        )
    newline = b"\n" if start[3:4] == b"\n" else b"\r\n" if start[4:5] == b"\n" else b"\r"
    # Some programs write spaces after the keyword. Without data, the newline may be missing.
    found = re.compile(newline + rb"end_header[ \t]*(" + newline + rb"|\Z)").search(start)
    if found is None:
        why = "is truncated" if len(start) < most else f"is longer than {most} bytes"
        raise SceneError(f"{path}: PLY header {why}; no line 'end_header' found")
    return start[: found.start()].decode("latin-1").split(newline.decode()), found.end()


def _reject_duplicates(names: list[str], what: str, path: Path) -> None:
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise SceneError(f"{path}: PLY header declares {what} {twice[0]!r} twice")
