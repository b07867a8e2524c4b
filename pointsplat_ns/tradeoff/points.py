"""The measurements of a scene, and the files they are written to: JSON, from which the next call resumes, and CSV."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from pointsplat_ns.compression.repair import Effort
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.io.discovery import FOLDER_FILES
from pointsplat_ns.io.files import one_line, read_text, write_csv, write_json
from pointsplat_ns.pruning import method_named

Repair = Literal["none", "refiner", "quick", "thorough", "photos"]
"""Kinds of repair: none; the refiner alone; the repair of ``compact`` of an effort; the effort ``quick``, and then a
training on the photos of a run."""

REPAIRS: tuple[Repair, ...] = get_args(Repair)

EFFORTS: dict[Repair, Effort] = {"refiner": "instant", "quick": "quick", "thorough": "thorough", "photos": "quick"}
"""The effort of ``compact`` for each repair."""

DENSE = "dense"
"""Key and method of the dense scene."""

RESULTS = {"json": FOLDER_FILES.sweep, "table": "tradeoff.csv", "page": "tradeoff.html"}
"""Names of the results in their folder, beside its pictures."""

VERSION = 6
"""Version of the JSON. Points of another version are not comparable."""


def repairs_of(effort: Effort) -> tuple[Repair, Repair]:
    """No repair, and the repair of an effort of ``compact``."""
    return "none", next(repair for repair, known in EFFORTS.items() if known == effort)


@dataclass(frozen=True)
class Setting:
    """A way of making a scene smaller."""

    count: int
    """Number of Gaussians kept."""
    sh_degree: int
    repair: Repair = "none"
    by: str = "merge"


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
    """Kind of repair, see :data:`Repair`."""
    bytes: int
    """Size of the file."""
    against_dense: ImageMetrics
    """Quality against renders of the dense scene, as every command says it
    (:mod:`~pointsplat_ns.compression.quality`); the dense scene's own PSNR is infinite. LPIPS is that of the
    pictures."""
    against_photos: ImageMetrics | None
    """Quality against held-out photos; None where there are none."""
    frame_ms: float
    """Time of one frame, in milliseconds: the dense scene's time at the start of the sweep, times the median over views
    of the ratio to a frame of the dense scene. Both are drawn in turn, so that points are comparable when the machine
    gets slower. NaN where nothing was timed."""
    frame_ms_low: float
    frame_ms_high: float
    """The same with the quartiles over views."""
    seconds: float
    """Duration of making the scene."""
    peak_bytes: int | None = None
    """Peak memory of the making process; None if it was not measured."""
    others_cores: float | None = None
    """Cores that other programs used during the timing; None if nothing was timed."""
    fill: float | None = None
    """Mean number of Gaussians that viewers draw on a pixel."""


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
    """Size of the pictures, in pixels."""
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
    """Text on the reason for it, and its cost."""
    target: str = ""
    """Text on the targets that were searched for, such as "at least 32 dB"; empty for a table."""
    judged_in: str = ""
    """Number and size of the views that scenes are judged in, as text."""

    def point(self, key: str) -> Point:
        """The point with a key. Raises KeyError if there is no such point."""
        return {point.key: point for point in self.points}[key]


def picture_path(folder: Path, view: int, what: str) -> Path:
    """Path of the picture of a view, by its number from 0, in the folder of a sweep: of a point's ``key``, or of the
    ``photo``."""
    return folder / "pictures" / f"{view:02d}_{what}.png"


def write_points(sweep: Tradeoff, identity: Mapping[str, str | int], folder: Path) -> None:
    """Write all points as JSON. ``identity`` has the values that comparable points have in common, by name."""
    content = {"version": VERSION, "of": identity, **dataclasses.asdict(sweep), "points": _rows(sweep)}
    write_json(content, folder / RESULTS["json"])


def write_table(sweep: Tradeoff, folder: Path) -> None:
    """Write all points as CSV. Qualities and speeds take a column for each number."""
    qualities = tuple(field.name for field in dataclasses.fields(ImageMetrics))
    parts_of = {"speed": Speed._fields, "against_dense": qualities, "against_photos": qualities}
    rows = _rows(sweep)
    for row in rows:
        for name, parts in parts_of.items():
            values = row.pop(name) or {}
            row |= {f"{name}_{part}": values.get(part) for part in parts}
    write_csv(rows, folder / RESULTS["table"])


def _rows(sweep: Tradeoff) -> list[dict[str, Any]]:
    """The values of all points, with their speeds."""
    dense = sweep.points[0]
    return [{**dataclasses.asdict(point), "speed": speed_of(point, dense)._asdict()} for point in sweep.points]


def check_folder(folder: Path) -> None:
    """Raise a SceneError if a folder has results without the JSON to resume from."""
    for path in (folder / RESULTS["table"], folder / RESULTS["page"]):
        if path.exists() and not (folder / RESULTS["json"]).exists():
            raise SceneError(
                f"{path}: exists already, without {RESULTS['json']} to resume from; name another folder, or overwrite "
                "it with --force"
            )


def read_points(folder: Path, identity: Mapping[str, str | int]) -> dict[Setting, Point]:
    """The points of an earlier call by setting. The file is not trusted; there are none if there is no file. Raises
    SceneError if it is damaged or of another version, or its points are of another identity."""
    path, mend = folder / RESULTS["json"], "name another folder, or start over with --force"
    if not path.exists():
        return {}
    try:
        content = json.loads(read_text(path, 16_000_000))  # a thousand points take one megabyte
        if content["version"] != VERSION:
            raise ValueError(f"of version {content['version']!r:.20}, this program's are of {VERSION}")
        of, points = dict(content["of"]), [_restored(row) for row in content["points"]]
        found = {_setting_of(point): point for point in points}
    except (OSError, ValueError, TypeError, KeyError, OverflowError, RecursionError, PointSplatError) as error:
        why = f"lacks {error}" if isinstance(error, KeyError) else one_line(error, 80)
        raise SceneError(f"{path}: not the points of a sweep ({why}); {mend}") from error
    for name, value in identity.items():
        if of.get(name) != value:
            raise SceneError(
                f"{path}: its points are of another sweep ({name}: {of.get(name)!r}, now {value!r}); {mend}"
            )
    return found


def _setting_of(point: Point) -> Setting:
    [repair] = [repair for repair in REPAIRS if repair == point.repair]
    by = point.by if point.by == DENSE else method_named(point.by).name
    return Setting(point.gaussians, point.sh_degree, repair, by)


def _restored(row: dict[str, Any]) -> Point:
    """The point of a row of the JSON, where an infinite PSNR is null. Raises a ValueError, a TypeError or a KeyError if
    it is none."""
    values = {name: row[name] for name in row if name != "speed"}
    for name in ("against_dense", "against_photos"):
        if (quality := values[name]) is not None:
            psnr = math.inf if quality["psnr"] is None else quality["psnr"]
            values[name] = _checked(ImageMetrics(**{**quality, "psnr": psnr}))
    point = Point(**values)
    _checked(point)
    return point


def _checked(record: Point | ImageMetrics) -> Point | ImageMetrics:
    """A record from a file. Raises a ValueError if a value has another type than its field."""
    kinds = {"str": (str,), "int": (int,), "float": (int, float), "ImageMetrics": (ImageMetrics,)}
    for field in dataclasses.fields(record):
        value, (kind, _, optional) = getattr(record, field.name), str(field.type).partition(" | ")
        fits = type(value) in kinds[kind] and value == value and not (kind == "int" and value < 0)
        if not fits and not (optional and value is None):
            raise ValueError(f"{field.name} is {value!r}")
    return record
