"""Measurements of a scene: one point for each way of making it smaller."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


@dataclass(frozen=True)
class ImageMetrics:
    """Means over views: PSNR in dB, SSIM, and LPIPS, which is None without its weights."""

    psnr: float
    ssim: float
    lpips: float | None = None


@dataclass(frozen=True)
class Point:
    """The measurement of one way of making a scene smaller."""

    key: str
    """Short name, unique in a sweep and fit for a file's name: ``dense``, ``10pct_sh3``, ``10pct_sh3_quick``."""
    label: str
    """The same for people: ``10 %, repaired (quick)``."""
    command: str
    """The exact command that produces the scene; empty for the dense one."""
    by: str
    """The method of pruning; ``dense`` for the scene as it is."""
    share: float
    """Share of the Gaussians kept."""
    gaussians: int
    sh_degree: int
    repair: str
    """Kind of repair, see :data:`~pointsplat_ns.tradeoff.settings.Repair`."""
    bytes: int
    """Size of the file."""
    against_dense: ImageMetrics
    """Quality against renders of the dense scene. The PSNR is that of the mean squared error of all views, over the
    pixels that the dense scene covers; the dense scene's own is infinite."""
    against_photos: ImageMetrics | None
    """Quality against held-out photos; None where there are none."""
    frame_ms: float
    """Time of one frame, in milliseconds: the dense scene's time at the start of the sweep, times the median over views
    of the ratio to a frame of the dense scene. Both are drawn in turn, so that points are comparable when the machine
    gets slower."""
    frame_ms_low: float
    frame_ms_high: float
    """The same with the quartiles over views."""
    seconds: float
    """Duration of making the scene."""
    peak_bytes: int | None = None
    """Peak memory of the making process; None if it was not measured."""
    others_cores: float | None = None
    """Cores that other programs used during the timing; None if they were not measured."""
    fill: float | None = None
    """Mean number of Gaussians that viewers draw on a pixel; None in points of older programs."""
    clock_ms: float | None = None
    """Median time of one frame over views by the clock, in milliseconds; None if it was not measured."""


def restored_point(values: dict[str, Any]) -> Point:
    """The inverse of :func:`dataclasses.asdict` for a point that was written as JSON, where an infinite PSNR is null.
    Errors are those of Python if the values are not those of a point."""
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
        if not _FITS[kind.removesuffix(" | None")](value) and not (value is None and kind.endswith("None")):
            raise ValueError(f"{field.name} is {value!r}")


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


_FITS: dict[str, Callable[[Any], bool]] = {
    "str": lambda value: isinstance(value, str),
    "int": _is_count,
    "float": lambda value: type(value) in (int, float) and not math.isnan(value),
    "ImageMetrics": lambda value: isinstance(value, ImageMetrics),
    "Point": lambda value: isinstance(value, Point),
    "tuple[int, ...]": lambda value: isinstance(value, tuple) and all(map(_is_count, value)),
}
"""Whether a value fits the annotation of a field, by the annotation."""


class Speed(NamedTuple):
    """Ratio of the dense scene's time of a frame to that of a point: median over views, and quartiles."""

    median: float
    low: float
    high: float


def speed_of(point: Point, dense: Point) -> Speed:
    """Speed of a point relative to the dense scene."""
    return Speed(*(dense.frame_ms / ms for ms in (point.frame_ms, point.frame_ms_high, point.frame_ms_low)))


@dataclass(frozen=True)
class Tradeoff:
    """All points of a scene. The first is the dense scene.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::200][:300], f"{folder}/room.ply")
        ...     options = {"keep": ("10%",), "repairs": ("none",), "views": 2, "resolution": "64x48"}
        ...     found = ps.measure_tradeoff(f"{folder}/room.ply", f"{folder}/trade", **options)
        >>> [point.key for point in found.points], found.point("10pct_sh1").gaussians
        (['dense', '10pct_sh1'], 30)
    """

    scene: str
    """Name of the scene."""
    machine: str
    """Processor, number of threads, device and version of torch, as text."""
    views_origin: str
    """Origin of the views."""
    width: int
    height: int
    """Size of the views, in pixels."""
    points: tuple[Point, ...]
    notes: tuple[str, ...] = ()
    """Lines of text for the reader, such as on a busy machine or missing LPIPS."""
    times_trusted: bool = True
    """Whether no other program disturbed the timing."""
    within: float = 0.5
    """Largest loss of the recommended point against photos, dB."""
    recommended: str = ""
    """``key`` of the recommended point, or of the point found for targets."""
    why: str = ""
    """One line of text on the reason for it, and its cost."""

    def point(self, key: str) -> Point:
        """The point with a key. Raises KeyError if there is no such point."""
        return {point.key: point for point in self.points}[key]


def picture_path(folder: Path, view: int, what: str) -> Path:
    """Path of the picture of a view, by its number from 0, in the folder of a sweep: of a point's ``key``, or of the
    ``photo``."""
    return folder / "pictures" / f"{view:02d}_{what}.png"
