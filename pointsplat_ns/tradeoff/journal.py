"""Journals: every record is written as soon as it is measured, so that an interrupted command can continue.

``points.json`` is the journal of a sweep.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.io.files import one_line, read_text, write_json
from pointsplat_ns.tradeoff.points import ImageMetrics, Point
from pointsplat_ns.tradeoff.settings import DENSE, Setting, setting_of

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Identity = Mapping[str, str | int]
"""Values that all records of a journal have in common, by name."""

Record = TypeVar("Record")


@dataclass(frozen=True)
class Form:
    """A kind of journal."""

    name: str
    version: int
    records: str
    """Name of the list of records, in the plural."""
    of: str
    """Name of the whole, in the singular."""
    most_bytes: int = 16_000_000
    """Largest size of a file; a thousand points take one megabyte."""

    def write(self, path: Path, identity: Identity, records: Sequence[DataclassInstance]) -> None:
        """Write all records."""
        rows = [dataclasses.asdict(record) for record in records]
        content = {"format": self.name, "version": self.version, "of": dict(identity), self.records: rows}
        write_json(content, path)

    def read(self, path: Path, restored: Callable[[dict[str, Any]], Record]) -> tuple[dict[str, Any], list[Record]]:
        """Read the identity and the records of a file, which is not trusted. ``restored`` makes a record from the
        result of :func:`dataclasses.asdict`; see :func:`check_types`. Raises SceneError if the file is not such a
        journal, or damaged."""
        try:
            content = json.loads(read_text(path, self.most_bytes))
            if content["format"] != self.name:
                raise ValueError(f"of format {content['format']}")
            if content["version"] != self.version:
                raise ValueError(f"of version {content['version']!r:.20}, this program's are of {self.version}")
            return dict(content["of"]), [restored(values) for values in content[self.records]]
        except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError, PointSplatError) as error:
            why = f"lacks {error}" if isinstance(error, KeyError) else one_line(error, 80)
            raise SceneError(
                f"{path}: not the {self.records} of {self.of} ({why}); name another folder, or start over with --force"
            ) from error

    def check(self, path: Path, of: Identity, identity: Identity) -> None:
        """Raise a SceneError if the identity ``of`` a file differs from the expected one."""
        for name, value in identity.items():
            if of.get(name) != value:
                raise SceneError(
                    f"{path}: its {self.records} are of another {self.of.removeprefix('a ')} ({name}: "
                    f"{of.get(name)!r}, now {value!r}); name another folder, or start over with --force"
                )


def check_journal_folder(
    folder: Path, records: str, outputs: Sequence[str], force: bool, older: Sequence[Path]
) -> None:
    """Check, before the long computations, that results may be written to a folder.

    Args:
        folder: need not exist.
        records: pattern of the journals in it, which a command goes on from.
        outputs: names of the results.
        force: remove ``older`` instead.
        older: journals that start over.

    Raises:
        SceneError: if the folder is a file, or holds results without journals.
    """
    if folder.exists() and not folder.is_dir():
        raise SceneError(f"{folder}: is a file; expected the name of a folder")
    if force:
        for path in older:
            path.unlink(missing_ok=True)
    elif not any(folder.glob(records)):
        for name in outputs:
            if (folder / name).exists():
                raise SceneError(
                    f"{folder / name}: exists already, without {Path(records).name} to go on from; name another "
                    "folder, or overwrite it with --force"
                )


POINTS_FORM = Form("pointsplat-tradeoff-points", 3, "points", "a sweep")
"""Points of version 1 were timed without the dense scene beside them, some of version 2 drawn in other qualities."""


class Journal:
    """The points of one scene, measured in the same views on the same machine, in the folder of a sweep. Raises
    SceneError if the folder holds points of another identity, or a file of points that cannot be read."""

    def __init__(self, folder: Path, identity: Identity):
        self.path, self._identity = folder / FOLDER_FILES.sweep_points, dict(identity)
        self.dense: Point | None = None
        self.points: dict[Setting, Point] = {}
        if self.path.exists():
            of, points = POINTS_FORM.read(self.path, _point_of_sweep)
            POINTS_FORM.check(self.path, of, self._identity)
            for point in points:
                self._take(point)

    def add(self, point: Point) -> None:
        """Add a point, and write all points."""
        self._take(point)
        points = ([self.dense] if self.dense is not None else []) + [*self.points.values()]
        POINTS_FORM.write(self.path, self._identity, points)

    def _take(self, point: Point) -> None:
        if point.by == DENSE:
            self.dense = point
        else:
            self.points[setting_of(point)] = point


def _point_of_sweep(values: dict[str, Any]) -> Point:
    point = restored_point(values)
    if point.by != DENSE:
        setting_of(point)
    return point


def restored_point(values: dict[str, Any]) -> Point:
    """The inverse of :func:`dataclasses.asdict` for a point. Errors are those of Python if the values are not those of
    a point."""
    qualities = {name: _quality(values[name]) for name in ("against_dense", "against_photos")}
    point = Point(**{**values, **qualities})
    check_types(point)
    return point


def _quality(values: dict[str, Any] | None) -> ImageMetrics | None:
    if values is None:
        return None
    quality = ImageMetrics(**{**values, "psnr": math.inf if values["psnr"] is None else values["psnr"]})
    check_types(quality)
    return quality


def check_types(of: DataclassInstance) -> None:
    """Raise a ValueError if a value of a record has another type than its field."""
    for field in dataclasses.fields(of):
        value, kind = getattr(of, field.name), str(field.type)
        if not _has_type(value, kind.removesuffix(" | None")) and not (value is None and kind.endswith("None")):
            raise ValueError(f"{field.name} is {value!r}")


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _has_type(value: Any, kind: str) -> bool:
    """Whether a value fits the annotation of a field."""
    checks: dict[str, Callable[[Any], bool]] = {
        "str": lambda value: isinstance(value, str),
        "int": _is_count,
        "float": lambda value: type(value) in (int, float) and not math.isnan(value),
        "ImageMetrics": lambda value: isinstance(value, ImageMetrics),
    }
    return checks[kind](value)
