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
from pathlib import Path

import numpy as np
import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import MAX_SH_DEGREE, Gaussians, Offset, Traits, sh_degree_of
from pointsplat_ns.io.files import logger, one_line, require_file, require_memory
from pointsplat_ns.io.offsets import SAMPLED, offset_for, offset_text
from pointsplat_ns.io.ply_dialects import COLUMNS, FILTER, attributes_of, columns_of, is_flat
from pointsplat_ns.io.ply_header import Element, Header, read_header, traits_of
from pointsplat_ns.io.ply_writing import column_names

MAX_REST = (MAX_SH_DEGREE + 1) ** 2 - 1
"""Number of SH coefficients per channel beyond the constant one that are read."""


def read_ply(path: Path | str) -> Gaussians:
    """Read a 3DGS PLY: binary of either byte order, or ASCII; properties in any order and of any type.

    The SH degree follows from the number of ``f_rest`` properties; of degree 4, the bands up to 3 are read. 2D
    Gaussians, which have no ``scale_2``, become flat ones. CloudCompare's prefixes of names, and Mip-Splatting's
    3D filter are understood (:mod:`~pointsplat_ns.io.ply_dialects`). Other properties and elements, and bytes after the
    last element, are not read; a warning says so.

    Raises:
        SceneError: if the file is not a PLY, is truncated, or lacks a property.
    """
    rows = PlyRows(path, whole=True)
    return rows.read(0, len(rows))


class PlyRows:
    """The Gaussians of a 3DGS PLY; of a binary one, they are read in pieces, and the whole need not fit into memory.

    Args:
        path: the file.
        warn: whether what is not read, and the offset of positions, are logged.
        whole: whether all rows will be read at once.

    Raises:
        SceneError: if the file is not a PLY, is truncated, or lacks a property.
    """

    path: Path
    count: int
    """Number of Gaussians in the file, those that cannot be drawn included."""
    rest: int
    """Number of SH coefficients per channel beyond the constant one that are read."""
    traits: Traits
    """What the file declares beside the Gaussians."""

    def __init__(self, path: Path | str, warn: bool = True, whole: bool = False):
        self.path = path = require_file(path, "a 3DGS PLY file")
        with _opened(path) as stream:
            header = read_header(stream, path)
        vertex = _gaussian_element(header, path)
        self.count, self._in_file = vertex.count, _num_rest(vertex, path)
        self.rest = min(self._in_file, MAX_REST)
        if whole:
            require_memory(path, vertex.count * 4 * (14 + 3 * self.rest))  # float32 numbers
        if warn:
            _report_unread(header, vertex, self._in_file, path)
        self._dtype = np.dtype([(name, header.order + np.dtype(kind).str[1:]) for name, kind in vertex.properties])
        self._names = self._dtype.names or ()
        self._start = header.size + sum(_least_bytes(element, header) for element in header.before("vertex"))
        self._parsed = None if header.order else _parsed(path, header, vertex)
        traits = traits_of(header, path)  # who trained with Mip-Splatting's 3D filter trained with antialiasing
        self.traits = traits._replace(antialiased=traits.antialiased or FILTER in self._names)
        self._shift: Offset | None = None
        if vertex.count and any(self._dtype[name].newbyteorder("=") == np.float64 for name in "xyz"):
            self._shift_positions(warn)

    @classmethod
    def open(cls, path: Path | str, warn: bool = True) -> PlyRows | None:
        """The rows of a file, which may ``warn``; None for an ASCII file, which has no rows of one length."""
        path = require_file(path, "a 3DGS PLY file")
        with _opened(path) as stream:
            return cls(path, warn) if read_header(stream, path).order else None

    def __len__(self) -> int:
        return self.count

    @property
    def sh_degree(self) -> int:
        """SH degree of the Gaussians as read."""
        return sh_degree_of(self.rest)

    def read(self, start: int, stop: int) -> Gaussians:
        """The Gaussians of rows ``start`` to ``stop`` - 1, float32, those that cannot be drawn included. Raises
        SceneError if the file cannot be read or has become shorter."""
        with _opened(self.path) as stream:
            return self._scene(stop - start, lambda these: self._rows(stream, [range(start, stop)[these]]))

    def pick(self, rows: Sequence[int]) -> Gaussians:
        """The Gaussians of single rows, as :meth:`read` gives them."""
        with _opened(self.path) as stream:
            return self._scene(len(rows), lambda these: self._rows(stream, [range(n, n + 1) for n in rows[these]]))

    def _rows(self, stream: io.BufferedReader, ranges: Sequence[range]) -> np.ndarray:
        """Rows in ranges, one after the other. Raises SceneError if the file has become shorter."""
        if self._parsed is not None:
            return np.concatenate([self._parsed[part.start : part.stop] for part in ranges])
        size, pieces = self._dtype.itemsize, []
        for part in ranges:
            stream.seek(self._start + part.start * size)
            pieces.append(stream.read(len(part) * size))
        if sum(map(len, pieces)) < size * sum(map(len, ranges)):
            raise SceneError(f"{self.path}: truncated while it was read; expected {self.count} Gaussians")
        return np.frombuffer(b"".join(pieces), self._dtype)

    def _shift_positions(self, warn: bool) -> None:
        """Subtract an offset from positions that float32 would round too far, which is logged if ``warn``."""
        with _opened(self.path) as stream:
            some = range(0, self.count, max(1, self.count // SAMPLED))
            rows = self._rows(stream, [range(number, number + 1) for number in some])
        scales = [name for name in COLUMNS["scales"] if name in self._names]
        self._shift = offset_for(_doubles(rows, COLUMNS["means"]), _doubles(rows, scales))
        if self._shift is not None:
            x, y, z = (a + b for a, b in zip(self.traits.offset or (0.0, 0.0, 0.0), self._shift, strict=True))
            self.traits = self.traits._replace(offset=(x, y, z))
            if warn:
                text = offset_text((x, y, z))
                logger.info("%s: positions are doubles; their offset %s is kept beside the scene", self.path, text)

    def _scene(self, count: int, rows_of: Callable[[slice], np.ndarray]) -> Gaussians:
        """The Gaussians in ``count`` rows, of which ``rows_of`` gives those of a slice."""
        from numpy.lib.recfunctions import structured_to_unstructured

        # Channel-major in the file, channel last in a scene.
        rest = [f"f_rest_{channel * self._in_file + i}" for i in range(self.rest) for channel in range(3)]
        columns = columns_of(self._names) | {"features_rest": rest}
        tables = {name: np.empty((count, len(fields)), np.float32) for name, fields in columns.items()}
        at_once = 16_384  # rows, about 4 MB: they fit into the processor's cache
        # A double beyond float32 becomes Inf and is dropped with the others.
        with np.errstate(over="ignore"):
            for start in range(0, count, at_once):
                chunk = slice(start, min(start + at_once, count))
                rows = rows_of(chunk)
                if self._shift is not None:
                    tables["means"][chunk] = _doubles(rows, COLUMNS["means"]) - self._shift
                for name, fields in columns.items():
                    if fields and not (name == "means" and self._shift is not None):
                        tables[name][chunk] = structured_to_unstructured(rows[fields], np.float32)
        tensors = {name: torch.from_numpy(table) for name, table in attributes_of(tables, self._names).items()}
        tensors["features_rest"] = tensors["features_rest"].reshape(count, self.rest, 3)
        antialiased, up, offset = self.traits
        return Gaussians(**tensors, antialiased=antialiased, up=up, offset=offset)


@contextmanager
def _opened(path: Path) -> Iterator[io.BufferedReader]:
    """The file, open. Raises SceneError if it cannot be read."""
    try:
        with path.open("rb") as stream:
            yield stream
    except OSError as error:
        raise SceneError(f"{path}: cannot be read ({error.strerror or one_line(error)})") from error


def _doubles(rows: np.ndarray, names: Sequence[str]) -> np.ndarray:
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _parsed(path: Path, header: Header, vertex: Element) -> np.ndarray:
    """The rows of an ASCII file. plyfile gets a checked header that ends with the Gaussians, so comments in other
    encodings and elements after the Gaussians cannot cause errors. Raises SceneError if they are damaged."""
    from plyfile import PlyData, PlyParseError

    try:
        with _GaussiansAlone(path, header) as stream:
            return PlyData.read(stream)["vertex"].data
    except (PlyParseError, ValueError, OverflowError) as error:
        wanted = f"{vertex.count} Gaussians of {len(vertex.properties)} numbers"
        raise SceneError(f"{path}: damaged PLY ({one_line(error)}); expected {wanted}") from error


class _GaussiansAlone(io.FileIO):
    """A PLY file whose header is another."""

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
