"""The measurements of a scene, and the JSON that they are written to."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from pointsplat_ns.pipeline.repair_budget import Effort
from pointsplat_ns.system.files import write_json

Repair = Literal["none", "quick", "thorough", "photos"]
"""Kinds of repair: none, those of ``compact`` by effort, and ``quick`` with a training on the
photos after it."""

REPAIRS: tuple[Repair, ...] = get_args(Repair)

EFFORTS: dict[Repair, Effort] = {"quick": "quick", "thorough": "thorough", "photos": "quick"}
"""The effort of ``compact`` for each repair."""

DENSE = "dense"
"""Key and method of the dense scene."""

RESULTS = {"json": "tradeoff.json", "page": "tradeoff.html"}
"""Names of the results in their folder."""


@dataclass(frozen=True)
class Setting:
    """A way of making a scene smaller: the number of Gaussians kept, a repair, and a method."""

    count: int
    repair: Repair = "none"
    by: str = "merge"


@dataclass(frozen=True)
class ImageMetrics:
    """Means over views: PSNR in dB, and SSIM."""

    psnr: float
    ssim: float


class Speed(NamedTuple):
    """Ratio of the dense scene's time of a frame to that of a point: median over views, and
    quartiles."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Point:
    """The measurement of one way of making a scene smaller."""

    key: str
    """Short name, unique in a table and fit for a file's name: ``dense``, ``10pct``,
    ``10pct_quick``."""
    label: str
    """The same for people: ``10 %, repaired (quick)``."""
    command: str
    """The exact command that produces the scene; empty for the dense one."""
    by: str
    """The method of pruning; ``dense`` for the scene as it is."""
    share: float
    """Share of the Gaussians kept."""
    gaussians: int
    repair: str
    """Kind of repair, see :data:`Repair`."""
    bytes: int
    """Size of the PLY."""
    against_dense: ImageMetrics
    """Quality against renders of the dense scene, as every command says it
    (:mod:`~pointsplat_ns.pipeline.quality`); the dense scene's own PSNR is infinite."""
    against_photos: ImageMetrics | None
    """Quality against held-out photos; None where there are none."""
    speed: Speed
    frame_ms: float
    """Milliseconds of a frame: the dense scene's at the start, divided by the median speed, so that
    points are comparable when the machine gets slower."""
    fill: float
    """Mean number of Gaussians that viewers draw on a pixel."""
    seconds: float
    """Duration of making the scene."""
    others_cores: float | None = None
    """Cores that other programs used during the timing; None if that is not known."""


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
        >>> found.point("10pct").gaussians
        30
    """

    scene: str
    """Name of the scene."""
    machine: str
    """Processor, number of threads, device and version of torch, as text."""
    views_origin: str
    """Origin of the views."""
    judged_in: str
    """Number and size of the views that scenes are judged in, as text."""
    width: int
    height: int
    """Size of the pictures, in pixels."""
    points: tuple[Point, ...]
    notes: tuple[str, ...]
    """Lines of text for the reader, such as on a busy machine."""
    recommended: str
    """``key`` of the recommended point."""
    why: str
    """Text on the reason for it."""

    def point(self, key: str) -> Point:
        """The point with a key. Raises KeyError if there is no such point."""
        return {point.key: point for point in self.points}[key]


def write_points(found: Tradeoff, folder: Path) -> None:
    """Write all points as JSON."""
    points = [
        {**dataclasses.asdict(point), "speed": point.speed._asdict()} for point in found.points
    ]
    write_json({**dataclasses.asdict(found), "points": points}, folder / RESULTS["json"])
