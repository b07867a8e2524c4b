"""3DGS PLY files: the exchange format of Gaussian splat viewers.

One ``vertex`` per Gaussian with the properties ``x y z nx ny nz f_dc_0..2 f_rest_0..(3K-1) opacity
scale_0..2 rot_0..3``, in Splatfacto's own parametrisation. ``f_rest`` is channel-major: all K
coefficients of red, then green, then blue. Normals are ignored and written as zeros.
"""

from __future__ import annotations

import copy
import functools
import io
import re
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from pointsplat_ns.errors import SceneError
from pointsplat_ns.geometry.harmonics import SH_C0
from pointsplat_ns.scene.activated import Activated, activated_in
from pointsplat_ns.scene.gaussians import (
    MAX_SH_DEGREE,
    PLAIN,
    Gaussians,
    Offset,
    Traits,
    sh_degree_of,
)
from pointsplat_ns.scene.moving import refuse_deformed, refuse_moving
from pointsplat_ns.scene.offsets import SAMPLED, offset_for, offset_text
from pointsplat_ns.scene.ply_header import Element, Header, first_lines, read_header, traits_of
from pointsplat_ns.scene.usable import keep_usable
from pointsplat_ns.system.files import (
    failure_named,
    logger,
    one_line,
    replacing,
    require_file,
    require_memory,
)
from pointsplat_ns.system.opening import open_regular
from pointsplat_ns.system.pieces import CHUNK

COLUMNS = {
    "means": ["x", "y", "z"],
    "normals": ["nx", "ny", "nz"],
    "features_dc": ["f_dc_0", "f_dc_1", "f_dc_2"],
    "opacities": ["opacity"],
    "scales": ["scale_0", "scale_1", "scale_2"],
    "quats": ["rot_0", "rot_1", "rot_2", "rot_3"],
}
"""Vertex properties of each attribute; normals are ignored and written as zeros."""

RGB = ["red", "green", "blue"]
"""Vertex properties of colours that some programs write in place of SH coefficients."""


def read_ply(path: Path | str) -> Gaussians:
    """Read a 3DGS PLY: binary of either byte order, or ASCII; properties of any type in any order.

    The SH degree follows from the number of ``f_rest`` properties; of degree 4, the bands up to 3
    are read. 2D Gaussians, which have no ``scale_2``, become flat ones. Colours may be ``red``,
    ``green`` and ``blue``: bytes, words, or floats from 0 to 1. Scales and opacities that are
    stored activated are told by their values, with a message. CloudCompare's name prefixes are
    removed. Other properties and elements are ignored with a warning.

    Raises:
        SceneError: if the file is not a PLY, is truncated, lacks a property, or holds points or a
            moving scene.
    """
    rows = PlyRows(path)
    require_memory(path, rows.count * 4 * (14 + 3 * rows.rest))  # float32 numbers
    return rows.read(0, len(rows))


class PlyRows:
    """The Gaussians of a 3DGS PLY. A binary file is read in pieces and need not fit into memory.

    Args:
        path: the file.
        warn: whether to log ignored properties and the offset of positions.

    Raises:
        SceneError: as :func:`read_ply`.
    """

    path: Path
    count: int
    """Number of Gaussians in the file, including those that cannot be drawn."""
    rest: int
    """Number of SH coefficients per channel beyond the constant one, as read."""
    traits: Traits
    """Properties that the file declares of the scene beside its Gaussians."""

    def with_sh_degree(self, degree: int) -> PlyRows:
        """The same rows, read with SH up to a degree."""
        rows = copy.copy(self)
        rows.rest = min(self.rest, (degree + 1) ** 2 - 1)
        return rows

    def __init__(self, path: Path | str, warn: bool = True):
        self.path = path = require_file(path, "a 3DGS PLY file")
        with failure_named(path, "read"), open_regular(path) as stream:
            self._header = header = read_header(stream, path)
        self._vertex = vertex = _gaussian_element(header, path)
        refuse_moving((name for name, _ in vertex.properties), path)
        refuse_deformed(path)
        self.count = vertex.count
        self._in_file = _num_rest(vertex, path)
        self.rest = min(self._in_file, (MAX_SH_DEGREE + 1) ** 2 - 1)
        if warn:
            _report_unread(header, vertex, self._in_file > self.rest, path)
        self._dtype = np.dtype(
            [(name, header.order + np.dtype(kind).str[1:]) for name, kind in vertex.properties]
        )
        present = self._dtype.names or ()
        self._scales = [name for name in COLUMNS["scales"] if name in present]
        self._colors = COLUMNS["features_dc"] if "f_dc_0" in present else RGB
        self._start = header.size + sum(
            _least_bytes(element, header) for element in header.before("vertex")
        )
        self.traits = traits_of(header, path)
        self._warn = warn
        self._shift: Offset | None = None
        if vertex.count and any(
            self._dtype[name].newbyteorder("=") == np.float64 for name in "xyz"
        ):
            self._shift_positions(warn)
        if header.order:
            _ = self._activated  # before the rows are copied and shared among processes

    @classmethod
    def open(cls, path: Path | str, warn: bool = True) -> PlyRows | None:
        """The rows of a file; None for an ASCII file, whose rows have different lengths. ``warn``
        is as for the class."""
        rows = cls(path, warn)
        return rows if rows._header.order else None

    def __len__(self) -> int:
        return self.count

    @property
    def sh_degree(self) -> int:
        """SH degree of the Gaussians as read."""
        return sh_degree_of(self.rest)

    def read(self, start: int, stop: int) -> Gaussians:
        """The Gaussians of rows ``start`` to ``stop`` - 1, float32, including those that cannot be
        drawn. Raises SceneError if the file cannot be read or was truncated meanwhile."""
        return self.pick(range(start, stop))

    def pick(self, rows: Sequence[int]) -> Gaussians:
        """The Gaussians of individual rows, as :meth:`read` returns them."""
        from numpy.lib.recfunctions import structured_to_unstructured

        # Channel-major in the file, channel-last in a scene.
        rest = [
            f"f_rest_{channel * self._in_file + i}"
            for i in range(self.rest)
            for channel in range(3)
        ]
        columns = {
            name: COLUMNS[name] for name in ("means", "scales", "quats", "opacities", "features_dc")
        }
        columns["features_rest"] = rest
        tables = {
            name: np.full((len(rows), len(fields)), -np.inf, np.float32)
            for name, fields in columns.items()
        }
        columns["scales"] = self._scales  # for 2D Gaussians the last stays -Inf: a flat axis
        columns["features_dc"] = self._colors
        at_once = 16_384  # rows, about 4 MB: they fit into the processor's cache
        # A double beyond float32 becomes Inf; its Gaussian is dropped like others with Inf.
        with (
            np.errstate(over="ignore"),
            failure_named(self.path, "read"),
            open_regular(self.path) as stream,
        ):
            for start in range(0, len(rows), at_once):
                chunk = slice(start, min(start + at_once, len(rows)))
                values = self._rows(stream, rows[chunk])
                if self._shift is not None:
                    tables["means"][chunk] = _doubles(values, COLUMNS["means"]) - self._shift
                for name, fields in columns.items():
                    if fields and not (name == "means" and self._shift is not None):
                        tables[name][chunk, : len(fields)] = structured_to_unstructured(
                            values[fields], np.float32
                        )
        self._deactivate(tables)
        tensors = {name: torch.from_numpy(table) for name, table in tables.items()}
        tensors["features_rest"] = tensors["features_rest"].reshape(len(rows), self.rest, 3)
        antialiased, up, offset = self.traits
        return Gaussians(**tensors, antialiased=antialiased, up=up, offset=offset)

    def _rows(self, stream: BinaryIO, numbers: Sequence[int]) -> np.ndarray:
        """Rows by index. Raises SceneError if the file was truncated meanwhile."""
        together = isinstance(numbers, range) and numbers.step == 1
        parts = [(numbers[0], len(numbers))] if together else [(number, 1) for number in numbers]
        if not self._header.order:
            return np.concatenate([self._parsed[first : first + count] for first, count in parts])
        size = self._dtype.itemsize
        pieces = []
        for first, count in parts:
            stream.seek(self._start + first * size)
            pieces.append(stream.read(count * size))
        if sum(map(len, pieces)) < size * len(numbers):
            raise SceneError(
                f"{self.path}: truncated while it was read; expected {self.count} Gaussians"
            )
        return np.frombuffer(b"".join(pieces), self._dtype)

    @functools.cached_property
    def _parsed(self) -> np.ndarray:
        """The rows of an ASCII file. plyfile gets a checked header that ends with the Gaussians, so
        comments in other encodings and later elements cannot cause errors. Raises SceneError if the
        rows are damaged."""
        from plyfile import PlyData, PlyParseError

        require_memory(self.path, 2 * self.path.stat().st_size)
        with failure_named(self.path, "read"):
            with open_regular(self.path) as stream:
                stream.seek(self._header.size)
                text = self._header.up_to("vertex") + stream.read()
        try:
            return PlyData.read(io.BytesIO(text))["vertex"].data
        except (PlyParseError, ValueError, OverflowError) as error:
            wanted = f"{self.count} Gaussians of {len(self._vertex.properties)} numbers"
            raise SceneError(
                f"{self.path}: damaged PLY ({one_line(error)}); expected {wanted}"
            ) from error

    def _sample(self) -> np.ndarray:
        """About :data:`SAMPLED` rows from all over the file."""
        with failure_named(self.path, "read"), open_regular(self.path) as stream:
            return self._rows(stream, [*range(0, self.count, max(1, self.count // SAMPLED))])

    @functools.cached_property
    def _activated(self) -> Activated:
        """The parameters that the file stores activated."""
        if not self.count:
            return Activated()
        rows = self._sample()
        found = activated_in(
            _doubles(rows, COLUMNS["means"]),
            _doubles(rows, self._scales),
            rows["opacity"].astype(np.float64),
            self.count,
        )
        if any(found) and self._warn:
            logger.warning(
                "%s: its %s are stored activated, as their values show, and read so",
                self.path,
                found,
            )
        return found

    @functools.cached_property
    def _color_range(self) -> float:
        """The number that stands for full intensity in ``red``, ``green`` and ``blue``."""
        kind = self._dtype[self._colors[0]].newbyteorder("=")
        if kind in (np.uint8, np.uint16):
            return float(np.iinfo(kind).max)
        colors = _doubles(self._sample(), self._colors)
        # some programs write bytes as floats
        return 255.0 if bool((colors > 2).any()) else 1.0

    def _deactivate(self, tables: dict[str, np.ndarray]) -> None:
        """Convert what the file stores in another form, in place: activated scales and opacities,
        and colours in place of SH coefficients. Negative scales become NaN."""
        with np.errstate(divide="ignore", invalid="ignore"):
            if self._activated.scales:
                stored = tables["scales"][:, : len(self._scales)]
                stored[:] = np.log(stored)
            if self._activated.opacities:
                shares = tables["opacities"].clip(0, 1)
                tables["opacities"] = np.log(shares) - np.log1p(-shares)
        if self._colors == RGB and len(tables["features_dc"]):
            tables["features_dc"] = (tables["features_dc"] / self._color_range - 0.5) / SH_C0

    def _shift_positions(self, warn: bool) -> None:
        """Subtract an offset if float32 loses too much precision; logged if ``warn``."""
        rows = self._sample()
        scales = _doubles(rows, self._scales)
        if self._activated.scales:
            with np.errstate(divide="ignore", invalid="ignore"):
                scales = np.log(scales)
        self._shift = offset_for(_doubles(rows, COLUMNS["means"]), scales)
        if self._shift is not None:
            x, y, z = (
                a + b
                for a, b in zip(self.traits.offset or (0.0, 0.0, 0.0), self._shift, strict=True)
            )
            self.traits = self.traits._replace(offset=(x, y, z))
            if warn:
                text = offset_text((x, y, z))
                logger.info(
                    "%s: positions are doubles; their offset %s is stored with the scene",
                    self.path,
                    text,
                )


def _doubles(rows: np.ndarray, names: Sequence[str]) -> np.ndarray:
    return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def _gaussian_element(header: Header, path: Path) -> Element:
    """The element that holds the Gaussians, with its count checked against the file size."""
    elements = {element.name: element for element in header.elements}
    vertex = elements.get("vertex")
    if vertex is None:
        raise SceneError(
            f"{path}: PLY has no element 'vertex' (found {', '.join(elements) or 'none'})"
        )
    if vertex.lists:
        raise SceneError(
            f"{path}: vertex property {vertex.lists[0]!r} is a list; expected a number per Gaussian"
        )
    before = header.before("vertex")
    listed = next((element.name for element in before if element.lists), None)
    if listed is not None and header.order:
        raise SceneError(
            f"{path}: element {listed!r} of lists stands before 'vertex'; expected 'vertex' first"
        )
    available = (
        path.stat().st_size - header.size - sum(_least_bytes(element, header) for element in before)
    )
    row = _least_bytes(Element("vertex", 1, vertex.properties), header)
    if vertex.properties and vertex.count * row > available:
        whole = max(available, 0) // row
        held = f"at most {whole}" if not header.order else f"{whole}"
        raise SceneError(
            f"{path}: truncated; the header declares {vertex.count} Gaussians of {row} bytes, the "
            f"file holds {held}"
        )
    return vertex


def _report_unread(header: Header, vertex: Element, higher: bool, path: Path) -> None:
    """Log a warning about content of a file that is not read."""
    if higher:
        logger.warning("%s: SH degree 4, read up to degree %d", path, MAX_SH_DEGREE)
    known = {name for names in COLUMNS.values() for name in names}
    if not any(name == "f_dc_0" for name, _ in vertex.properties):
        known.update(RGB)
    others = [
        name
        for name, _ in vertex.properties
        if name not in known and not name.startswith("f_rest_")
    ]
    unread = (
        [f"the vertex properties {', '.join(others[:4])}{'...' if len(others) > 4 else ''}"]
        if others
        else []
    )
    unread += [
        f"the element {element.name!r}"
        for element in header.elements
        if element != vertex and element.count
    ]
    if unread:
        logger.warning("%s: not read: %s", path, "; ".join(unread[:4]))


def _least_bytes(element: Element, header: Header) -> int:
    """Minimum number of bytes of an element: exact for binary; a digit and a separator per number
    for ASCII."""
    if header.order:
        return element.count * element.row_bytes
    # The newline of the last line is optional.
    return max(element.count * 2 * len(element.properties) - 1, 0)


def _num_rest(vertex: Element, path: Path) -> int:
    """Number of SH coefficients per channel beyond the constant one. Checks that all properties are
    present."""
    present = {name for name, _ in vertex.properties}
    if "packed_position" in present:
        raise SceneError(
            f"{path}: a compressed PLY (property 'packed_position'); expected a plain one"
        )
    if "filter_3D" in present:
        raise SceneError(
            f"{path}: Mip-Splatting's 3D filter is not fused into scales (property 'filter_3D'); "
            "expected both fused, as its create_fused_ply.py writes them"
        )
    if not present & {"opacity", "scale_0", "rot_0"}:
        raise SceneError(
            f"{path}: points, no Gaussians (no vertex property 'opacity', 'scale_0' or 'rot_0'); "
            "expected a 3DGS PLY; a training of Gaussians, such as ns-train splatfacto, can start "
            "from points"
        )
    if "f_dc_0" not in present and present.issuperset(RGB):
        present.update(COLUMNS["features_dc"])
    if "scale_2" not in present and {"scale_0", "scale_1", "opacity"} <= present:
        logger.warning("%s: 2D Gaussians (no 'scale_2'), read as flat 3D ones", path)
        present.add("scale_2")
    rest = sorted(
        int(name[7:]) for name in present if re.fullmatch(r"f_rest_(0|[1-9]\d{0,5})", name)
    )
    counts = [3 * ((degree + 1) ** 2 - 1) for degree in range(5)]
    required = column_names(rest[-1] + 1 if rest and rest[-1] + 1 in counts else 0)
    missing = [name for name in required if name not in present and name not in COLUMNS["normals"]]
    if missing:
        others = (
            f" and {len(missing) - 1} more ({', '.join(missing[1:4])}...)"
            if len(missing) > 1
            else ""
        )
        raise SceneError(
            f"{path}: lacks the vertex property {missing[0]!r}{others}; expected a 3DGS PLY"
        )
    if len(rest) not in counts:
        raise SceneError(
            f"{path}: has {len(rest)} f_rest properties; expected "
            f"{', '.join(map(str, counts[:-1]))} or {counts[-1]} (SH degree 0 to 4)"
        )
    return len(rest) // 3


def write_ply(scene: Gaussians, path: Path | str) -> None:
    """Write ``scene`` as a 3DGS PLY: binary little endian, float32, the reference's property order.

    :func:`read_ply` reads a float32 scene back exact to the bit. Gaussians that cannot be drawn
    (NaN, or Inf where it is not valid) are dropped, and their number is logged. The write is
    atomic.

    Raises:
        SceneError: if ``path`` cannot be written.
    """
    scene = keep_usable(scene.detach().to("cpu", torch.float32), path)
    about = len(scene), scene.sh_degree, scene.traits
    with replacing(path, ply_bytes(*about)) as part, part.open("wb") as stream:
        stream.write(header_bytes(*about))
        for first in range(0, len(scene), CHUNK):
            stream.write(row_table(scene[first : first + CHUNK]).data)


def row_table(scene: Gaussians) -> np.ndarray:
    """Rows of a 3DGS PLY, (N, 17 + 3 K) little-endian float32, of a float32 scene on the CPU."""
    rest = scene.features_rest.transpose(1, 2).reshape(len(scene), 3 * scene.features_rest.shape[1])
    values = [scene.means, torch.zeros_like(scene.means), scene.features_dc, rest]
    values += [scene.opacities, scene.scales, scene.quats]
    return np.ascontiguousarray(torch.cat(values, dim=1).numpy().astype("<f4", copy=False))


def header_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> bytes:
    """The header of a 3DGS PLY of ``count`` Gaussians, to be followed by :func:`row_table`."""
    names = column_names(3 * ((sh_degree + 1) ** 2 - 1))
    lines = [*first_lines(traits), f"element vertex {count}"]
    return "\n".join(
        [*lines, *(f"property float {name}" for name in names), "end_header", ""]
    ).encode("ascii")


def ply_bytes(count: int, sh_degree: int, traits: Traits = PLAIN) -> int:
    """Size of the 3DGS PLY of ``count`` Gaussians, bytes: an ASCII header, then per Gaussian 17
    float32 (including normals) and three per SH coefficient beyond the constant one."""
    return (
        len(header_bytes(count, sh_degree, traits))
        + 4 * (17 + 3 * ((sh_degree + 1) ** 2 - 1)) * count
    )


def column_names(rest: int) -> list[str]:
    """Vertex properties in file order, with ``rest`` SH coefficients beyond the constant one."""
    first = [*COLUMNS["means"], *COLUMNS["normals"], *COLUMNS["features_dc"]]
    last = [*COLUMNS["opacities"], *COLUMNS["scales"], *COLUMNS["quats"]]
    return [*first, *(f"f_rest_{i}" for i in range(rest)), *last]
