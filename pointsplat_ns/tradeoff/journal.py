"""``points.json``: every point, written as soon as it is measured, so that a sweep goes on where it was interrupted."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.files import one_line, write_json
from pointsplat_ns.tradeoff.points import Point, Quality
from pointsplat_ns.tradeoff.settings import DENSE, Setting, setting_of

POINTS = "points.json"

FORMAT, VERSION = "pointsplat-tradeoff-points", 2
"""Version 1 timed each point alone, as the clock said it: its times do not compare with those of today."""

MOST_BYTES = 16_000_000
"""Largest journal that is read; a thousand points take one megabyte."""


class Journal:
    """The points of one scene, measured in the same views on the same machine.

    Args:
        folder: of the sweep.
        identity: what all points have in common; texts and whole numbers by name.

    Raises:
        SceneError: if the folder holds points of something else, or a file of points that cannot be read.
    """

    def __init__(self, folder: Path, identity: Mapping[str, str | int]):
        self.path, self._identity = folder / POINTS, dict(identity)
        self.dense: Point | None = None
        self.points: dict[Setting, Point] = {}
        if self.path.exists():
            self._read()

    def add(self, point: Point) -> None:
        """Take a point in, and write all of them.

        Raises:
            SceneError: if they cannot be written.
        """
        self._take(point)
        points = ([self.dense] if self.dense is not None else []) + [*self.points.values()]
        content = {
            "format": FORMAT,
            "version": VERSION,
            "of": self._identity,
            "points": [dataclasses.asdict(point) for point in points],
        }
        write_json(content, self.path)

    def _take(self, point: Point) -> None:
        if point.by == DENSE:
            self.dense = point
        else:
            self.points[setting_of(point)] = point

    def _read(self) -> None:
        try:
            if self.path.stat().st_size > MOST_BYTES:
                raise ValueError(f"larger than {MOST_BYTES:,} bytes")
            content = json.loads(self.path.read_text("utf-8"))
            if content["format"] != FORMAT:
                raise ValueError(f"of format {content['format']}")
            version, of = content["version"], dict(content["of"])
            points = [_point(values) for values in content["points"]] if version == VERSION else []
        except (OSError, ValueError, TypeError, KeyError, RecursionError, PointSplatError) as error:
            why = f"lacks {error}" if isinstance(error, KeyError) else one_line(error, 80)
            raise SceneError(
                f"{self.path}: not the points of a sweep ({why}); name another folder, or start over with --force"
            ) from error
        if version != VERSION:
            raise SceneError(
                f"{self.path}: its points are of version {version!r:.20}, and this program's of {VERSION}, which "
                "times frames otherwise; name another folder, or start over with --force"
            )
        for name, value in self._identity.items():
            if of.get(name) != value:
                raise SceneError(
                    f"{self.path}: its points are of another sweep ({name}: {of.get(name)!r}, now {value!r}); name "
                    "another folder, or start over with --force"
                )
        for point in points:
            self._take(point)


def _point(values: dict[str, Any]) -> Point:
    """A point from what :func:`dataclasses.asdict` made of it.

    Raises:
        ValueError, TypeError, KeyError, PointSplatError: if it is none.
    """
    qualities = {name: _quality(values[name]) for name in ("against_dense", "against_photos")}
    point = Point(**{**values, **qualities})
    _check(point)
    if point.by != DENSE:
        setting_of(point)
    return point


def _quality(values: dict[str, Any] | None) -> Quality | None:
    if values is None:
        return None
    quality = Quality(**{**values, "psnr": math.inf if values["psnr"] is None else values["psnr"]})
    _check(quality)
    return quality


def _check(of: Point | Quality) -> None:
    """Whether the values have the types that the fields say."""
    for field in dataclasses.fields(of):
        value, kind = getattr(of, field.name), str(field.type)
        fits = {
            "str": isinstance(value, str),
            "int": type(value) is int and value >= 0,
            "float": type(value) in (int, float) and not math.isnan(value),
            "Quality": isinstance(value, Quality),
        }[kind.removesuffix(" | None")]
        if not fits and not (value is None and kind.endswith("None")):
            raise ValueError(f"{field.name} is {value!r}")
