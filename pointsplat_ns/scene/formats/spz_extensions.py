"""Extension records of SPZ files, and the axes that one of them declares.

A record is a type (u32), a length (u32), and that number of bytes. Version 4 has records between
its header and its table, versions 2 and 3 after the last attribute. Source: extensions/README.md
and ``coordinateConverter`` of the format's library, github.com/nianticlabs/spz.
"""

from __future__ import annotations

import struct
from pathlib import Path

import torch
from torch import Tensor

from pointsplat_ns.errors import SceneError
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.rotation import turned
from pointsplat_ns.system.files import logger
from pointsplat_ns.system.tensors import DOUBLES

MOST_RECORDS = 64
"""Most records of a file; each may be logged."""

_RECORD = struct.Struct("<II")  # type, length

AXES = 0xADBE0003
"""Type of the record that declares axes (``SPZ_ADOBE_coordinate_system``): a number (u32)."""

_SYSTEMS = (
    *("LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
"""Directions of x, y and z by the number in a file, from 1 on: left or right, down or up, front or
back."""

_RDF = 6
"""The axes of PLY files for the format's library, and so of scenes here."""

DECLARED_AXES = _RECORD.pack(AXES, 4) + struct.pack("<I", _RDF)
"""The record of files that are written. Scenes keep the axes of their PLY."""


def records_of(data: bytes | memoryview, path: Path) -> list[tuple[int, bytes]]:
    """Type and content of all records. Raises SceneError if the last one is
    cut short, or there are too many."""
    records: list[tuple[int, bytes]] = []
    start = 0
    while start < len(data):
        if len(records) == MOST_RECORDS:
            raise SceneError(
                f"{path}: more than {MOST_RECORDS} extensions; expected an SPZ file with a few"
            )
        kind, size = _RECORD.unpack(bytes(data[start : start + _RECORD.size]).ljust(_RECORD.size))
        end = start + _RECORD.size + size
        if end > len(data):
            raise SceneError(
                f"{path}: truncated; an extension of the SPZ file ends after "
                f"{len(data) - start} of {end - start} bytes"
            )
        records.append((kind, bytes(data[start + _RECORD.size : end])))
        start = end
    return records


def turned_back(
    scene: Gaussians, records: list[tuple[int, bytes]], path: Path, turn: bool = True
) -> Gaussians:
    """A scene turned from the axes that records declare to those of a PLY (right, down, front),
    unless ``turn`` is False. All other records are ignored, and logged. Raises SceneError if the
    axes are not a number."""
    axes = 0
    for kind, content in records:
        if kind != AXES:
            logger.warning(
                "%s: an extension of the SPZ file, type 0x%08X with %d bytes, is ignored",
                path,
                kind,
                len(content),
            )
        elif len(content) != 4:
            raise SceneError(
                f"{path}: the extension that declares the axes has {len(content)} bytes; expected 4"
            )
        else:
            axes = axes or int.from_bytes(content, "little")
            if not 1 <= axes <= len(_SYSTEMS):
                logger.warning("%s: declares unknown axes (%d), which are ignored", path, axes)
    if not turn or axes == _RDF or not 1 <= axes <= len(_SYSTEMS):
        return scene
    logger.info("%s: turned back from the axes that it declares, %s", path, _SYSTEMS[axes - 1])
    return turned(scene, _matrix_from(axes))


def _matrix_from(axes: int) -> Tensor:
    """Matrix (3, 3), float64, from declared axes to right, down, front.

    As in the format's library, each of the three bits of the number less 1 is the sign of an axis,
    and the upper eight systems differ from the lower eight by a quarter turn about x. For LFD, RFD,
    LBU and RBU this is half a turn about x from what their letters say. Files with these axes are
    written by that library.
    """
    apart = (axes - 1) ^ (_RDF - 1)
    signs = torch.tensor([-1.0 if apart >> axis & 1 else 1.0 for axis in range(3)], **DOUBLES)
    flips = torch.diag(signs)
    if not apart & 8:
        return flips
    quarter = torch.tensor([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]], **DOUBLES)
    return quarter @ flips
