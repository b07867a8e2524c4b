"""3DGS PLY files: the format that viewers of Gaussian scenes exchange.

One ``vertex`` per Gaussian with the properties ``x y z nx ny nz f_dc_0..2 f_rest_0..(3K-1) opacity
scale_0..2 rot_0..3``, in Splatfacto's own parametrisation. ``f_rest`` is channel-major: all K
coefficients of red, then green, then blue. Normals are not used; they are written as zeros.
"""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import MAX_SH_DEGREE, Gaussians, Offset, Traits, sh_degree_of
from pointsplat_ns.io.files import keep_usable, logger, one_line, require_file, require_memory
from pointsplat_ns.io.offsets import SAMPLED, has_doubles, positions_of, shift_of, with_shift
from pointsplat_ns.io.ply_dialects import (
    COLORS,
    COLUMNS,
    FILTER,
    attributes_of,
    columns_of,
    has_plain_colors,
    is_flat,
    with_plain_names,
)
from pointsplat_ns.io.ply_header import Element, Header, read_header, traits_of
from pointsplat_ns.io.ply_writing import column_names

MAX_REST = (MAX_SH_DEGREE + 1) ** 2 - 1
"""Number of SH coefficients per channel beyond the constant one that are read."""


def read_ply(path: Path | str) -> Gaussians:
    """Read a 3DGS PLY: binary of either byte order, or ASCII; properties in any order and of any type.

    The SH degree follows from the number of ``f_rest`` properties; of degree 4, the bands up to 3 are read. 2D
    Gaussians, which have no ``scale_2``, become flat ones. Names with CloudCompare's prefixes, colours as red, green
    and blue, and Mip-Splatting's 3D filter are understood (:mod:`~pointsplat_ns.io.ply_dialects`). Other properties
    and elements, and bytes after the last element, are not read; a warning says so. Gaussians that cannot be drawn
    (NaN, or Inf where it is not valid) are dropped, and their number is logged; all-zero rows are kept (a zero
    quaternion is the identity).

    Raises:
        SceneError: if the file is not a PLY, is truncated, or lacks a property.
    """
    from plyfile import PlyData, PlyParseError

    path = require_file(path, "a 3DGS PLY file")
    try:
        header, vertex, in_file = _checked(path)
        k = min(in_file, MAX_REST)
        require_memory(path, vertex.count * 4 * (14 + 3 * k))  # float32 numbers
        _report_unread(header, vertex, in_file, path)
        if header.order:
            scene = PlyRows.of(path, header, vertex, in_file).read(0, vertex.count)
        else:
            with _GaussiansAlone(path, header) as stream:
                rows = PlyData.read(stream)["vertex"].data
            shift = shift_of(rows[:: max(1, len(rows) // SAMPLED)])
            traits = with_shift(_traits(header, vertex, path), shift, path)
            scene = _scene(len(rows), lambda these: rows[these], k, in_file, traits, shift)
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror or one_line(error)})") from error
    except (PlyParseError, ValueError, OverflowError) as error:
        wanted = f"{vertex.count} Gaussians of {len(vertex.properties)} numbers"
        raise SceneError(f"{path}: damaged PLY ({one_line(error)}); expected {wanted}") from error
    return keep_usable(scene, path)


@dataclass(frozen=True)
class PlyRows:
    """The Gaussians of a binary 3DGS PLY, read from the file in pieces: the whole need not fit into memory."""

    path: Path
    count: int
    """Number of Gaussians in the file, those that cannot be drawn included."""
    rest: int
    """Number of SH coefficients per channel beyond the constant one that are read."""
    traits: Traits
    """What the file declares beside the Gaussians."""
    _dtype: np.dtype
    """Properties of a row."""
    _start: int
    """Where the first row begins, bytes."""
    _in_file: int
    """Number of SH coefficients per channel beyond the constant one in the file."""
    _shift: Offset | None = None
    """What is subtracted from positions."""

    @classmethod
    def open(cls, path: Path | str, warn: bool = True) -> PlyRows | None:
        """The rows of a file, its header checked as by :func:`read_ply`, which may ``warn``; None for an ASCII file,
        which has no rows of one length. Raises SceneError as :func:`read_ply` does."""
        path = require_file(path, "a 3DGS PLY file")
        header, vertex, in_file = _checked(path)
        if not header.order:
            return None
        if warn:
            _report_unread(header, vertex, in_file, path)
        return cls.of(path, header, vertex, in_file, warn)

    @classmethod
    def of(cls, path: Path, header: Header, vertex: Element, in_file: int, warn: bool = True) -> PlyRows:
        """The rows of a file with what :func:`_checked` found in it; an offset is logged if ``warn``."""
        dtype = np.dtype([(name, header.order + np.dtype(kind).str[1:]) for name, kind in vertex.properties])
        start = header.size + sum(_least_bytes(element, header) for element in header.before("vertex"))
        rows = cls(path, vertex.count, min(in_file, MAX_REST), _traits(header, vertex, path), dtype, start, in_file)
        if vertex.count and has_doubles(dtype):
            with rows._opened() as stream:
                some = range(0, vertex.count, max(1, vertex.count // SAMPLED))
                shift = shift_of(rows._table(b"".join(rows._row(number, stream) for number in some), len(some)))
            rows = replace(rows, traits=with_shift(rows.traits, shift, path if warn else None), _shift=shift)
        return rows

    def __len__(self) -> int:
        return self.count

    @property
    def sh_degree(self) -> int:
        """SH degree of the Gaussians as read."""
        return sh_degree_of(self.rest)

    def read(self, start: int, stop: int) -> Gaussians:
        """The Gaussians of rows ``start`` to ``stop`` - 1, float32, those that cannot be drawn included. Raises
        SceneError if the file cannot be read or has become shorter."""
        size = self._dtype.itemsize
        with self._opened() as stream:
            stream.seek(self._start + start * size)
            return self._scene(stop - start, lambda these: stream.read((these.stop - these.start) * size))

    def pick(self, rows: Sequence[int]) -> Gaussians:
        """The Gaussians of single rows, as :meth:`read` gives them."""
        with self._opened() as stream:
            return self._scene(len(rows), lambda these: b"".join(self._row(number, stream) for number in rows[these]))

    def _row(self, number: int, stream: io.BufferedReader) -> bytes:
        stream.seek(self._start + number * self._dtype.itemsize)
        return stream.read(self._dtype.itemsize)

    def _table(self, data: bytes, count: int) -> np.ndarray:
        """The rows (count,) in bytes of the file. Raises SceneError if it has become shorter."""
        if len(data) < self._dtype.itemsize * count:
            raise SceneError(f"{self.path}: truncated while it was read; expected {self.count} Gaussians")
        return np.frombuffer(data, self._dtype)

    @contextmanager
    def _opened(self) -> Iterator[io.BufferedReader]:
        """The file, open. Raises SceneError if it cannot be read."""
        try:
            with self.path.open("rb") as stream:
                yield stream
        except OSError as error:
            raise SceneError(f"{self.path}: cannot be read ({error.strerror or one_line(error)})") from error

    def _scene(self, count: int, bytes_of: Callable[[slice], bytes]) -> Gaussians:
        """The Gaussians of ``count`` rows, of which ``bytes_of`` gives those of a slice."""

        def rows_of(these: slice) -> np.ndarray:
            return self._table(bytes_of(these), these.stop - these.start)

        return _scene(count, rows_of, self.rest, self._in_file, self.traits, self._shift)


def _checked(path: Path) -> tuple[Header, Element, int]:
    """The header of a file, the element that holds the Gaussians, and :func:`_num_rest` of it. Raises SceneError if it
    is not a 3DGS PLY, or cannot be read."""
    try:
        with path.open("rb") as stream:
            header = with_plain_names(read_header(stream, path))
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror or one_line(error)})") from error
    vertex = _gaussian_element(header, path)
    return header, vertex, _num_rest(vertex, path)


def _traits(header: Header, vertex: Element, path: Path) -> Traits:
    """The traits of a scene; one with Mip-Splatting's 3D filter was trained with antialiasing."""
    traits = traits_of(header, path)
    return traits._replace(antialiased=traits.antialiased or FILTER in {name for name, _ in vertex.properties})


class _GaussiansAlone(io.FileIO):
    """A PLY file as plyfile reads it, with its header replaced by a checked one that ends with the Gaussians. So
    comments in other encodings and elements after the Gaussians cannot cause errors."""

    def __init__(self, path: Path, header: Header):
        super().__init__(path)
        self.seek(header.size)
        self._header = io.BytesIO(header.up_to("vertex"))

    def read(self, size: int | None = -1, /) -> bytes:
        """Bytes of the header until it ends, then of the file."""
        return self._header.read(size) or super().read(-1 if size is None else size)


def _gaussian_element(header: Header, path: Path) -> Element:
    """The element that holds the Gaussians, its declared count checked against the bytes in the file."""
    elements = {element.name: element for element in header.elements}
    vertex = elements.get("vertex")
    if vertex is None:
        raise SceneError(f"{path}: PLY has no element 'vertex' (found {', '.join(elements) or 'none'})")
    if vertex.lists:
        raise SceneError(f"{path}: vertex property {vertex.lists[0]!r} is a list; expected a number per Gaussian")
    before = header.before("vertex")
    listed = next((element.name for element in before if element.lists), None)
    if listed is not None and header.order:
        raise SceneError(f"{path}: element {listed!r} of lists stands before 'vertex'; expected 'vertex' first")
    available = path.stat().st_size - header.size - sum(_least_bytes(element, header) for element in before)
    row = _least_bytes(Element("vertex", 1, vertex.properties), header)
    if vertex.properties and vertex.count * row > available:
        whole = max(available, 0) // row
        held = f"at most {whole}" if not header.order else f"{whole}"
        raise SceneError(
            f"{path}: truncated; the header declares {vertex.count} Gaussians of {row} bytes, the file holds {held}"
        )
    return vertex


def _report_unread(header: Header, vertex: Element, in_file: int, path: Path) -> None:
    """Warn of what a file holds beside the Gaussians that are read."""
    if in_file > MAX_REST:
        logger.warning("%s: SH degree 4, read up to degree %d", path, MAX_SH_DEGREE)
    known = {name for names in COLUMNS.values() for name in names} | {FILTER}
    present = {name for name, _ in vertex.properties}
    if has_plain_colors(present):
        known |= {*COLORS}
        logger.info("%s: colours are those of 'red', 'green' and 'blue'", path)
    if FILTER in present:
        logger.info("%s: Mip-Splatting's 3D filter is put into sizes and opacities", path)
    others = [name for name, _ in vertex.properties if name not in known and not name.startswith("f_rest_")]
    unread = [f"the vertex properties {', '.join(others[:4])}{'...' if len(others) > 4 else ''}"] if others else []
    unread += [f"the element {element.name!r}" for element in header.elements if element != vertex and element.count]
    if header.order and not any(element.lists for element in header.elements):
        after = path.stat().st_size - header.size - sum(_least_bytes(element, header) for element in header.elements)
        unread += [f"{after} bytes after the last element"] if after > 0 else []
    if unread:
        logger.warning("%s: not read: %s", path, "; ".join(unread[:4]))


def _least_bytes(element: Element, header: Header) -> int:
    """Least number of bytes of an element: exact in binary; one digit and one separator per number in ASCII."""
    if header.order:
        return element.count * element.row_bytes
    # The last line of a file needs no newline.
    return max(element.count * 2 * len(element.properties) - 1, 0)


def _num_rest(vertex: Element, path: Path) -> int:
    """Number of SH coefficients per channel beyond the constant one; checks that all properties are present."""
    present = {name for name, _ in vertex.properties}
    if "packed_position" in present:
        raise SceneError(f"{path}: a compressed PLY (property 'packed_position'); expected a plain one")
    if is_flat(present):
        logger.warning("%s: 2D Gaussians (no 'scale_2'), read as flat 3D ones", path)
        present.add("scale_2")
    if has_plain_colors(present):
        present |= {*COLUMNS["features_dc"]}
    rest = sorted(int(name[7:]) for name in present if re.fullmatch(r"f_rest_(0|[1-9]\d{0,5})", name))
    counts = [3 * ((degree + 1) ** 2 - 1) for degree in range(5)]
    required = column_names(rest[-1] + 1 if rest and rest[-1] + 1 in counts else 0)
    missing = [name for name in required if name not in present and name not in COLUMNS["normals"]]
    if missing:
        others = f" and {len(missing) - 1} more ({', '.join(missing[1:4])}...)" if len(missing) > 1 else ""
        raise SceneError(f"{path}: lacks the vertex property {missing[0]!r}{others}; expected a 3DGS PLY")
    if len(rest) not in counts:
        raise SceneError(
            f"{path}: has {len(rest)} f_rest properties; expected {', '.join(map(str, counts[:-1]))} or {counts[-1]} "
            "(SH degree 0 to 4)"
        )
    return len(rest) // 3


def _scene(
    count: int,
    rows_of: Callable[[slice], np.ndarray],
    k: int,
    in_file: int,
    traits: Traits,
    shift: Offset | None,
) -> Gaussians:
    """The scene in ``count`` structured rows, of which ``rows_of`` gives those of a slice, with ``k`` coefficients per
    channel beyond the constant one, of ``in_file`` that the file has. ``shift`` is subtracted from positions."""
    from numpy.lib.recfunctions import structured_to_unstructured

    kinds = rows_of(slice(0, 0)).dtype
    # Channel-major in the file, channel last in a scene.
    rest = [f"f_rest_{channel * in_file + i}" for i in range(k) for channel in range(3)]
    columns = columns_of(kinds.names or ()) | {"features_rest": rest}
    tables = {name: np.empty((count, len(fields)), np.float32) for name, fields in columns.items()}
    at_once = 16_384  # rows, about 4 MB: they fit into the processor's cache
    # A double beyond float32 becomes Inf and is dropped with the others.
    with np.errstate(over="ignore"):
        for start in range(0, count, at_once):
            chunk = slice(start, min(start + at_once, count))
            rows = rows_of(chunk)
            if shift is not None:
                tables["means"][chunk] = positions_of(rows) - shift
            for name, fields in columns.items():
                if fields and not (name == "means" and shift is not None):
                    tables[name][chunk] = structured_to_unstructured(rows[fields], np.float32)
    tensors = {name: torch.from_numpy(table) for name, table in attributes_of(tables, kinds).items()}
    tensors["features_rest"] = tensors["features_rest"].reshape(count, k, 3)
    return Gaussians(**tensors, antialiased=traits.antialiased, up=traits.up, offset=traits.offset)
