"""Measurements of a scene, and their JSON file."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from pointsplat_ns.pipeline.repair_budget import Effort
from pointsplat_ns.pipeline.view_provider import VIEW_COUNTS
from pointsplat_ns.scene.views import ImageSize
from pointsplat_ns.system.files import write_json

Repair = Literal["none", "quick", "thorough", "photos"]
"""Kinds of repair: none, the efforts of ``compact``, and its training on photos."""

REPAIRS: tuple[Repair, ...] = get_args(Repair)

EFFORTS: dict[Repair, Effort] = {"quick": "quick", "thorough": "thorough", "photos": "quick"}
"""Effort of ``compact`` by repair."""


class Extent(NamedTuple):
    """What a measurement covers by default."""

    keep: tuple[str, ...]
    """Budgets."""
    repairs: tuple[Repair, ...]
    views: int
    """Maximum number of timed views and of photos."""
    shrink: int
    """Factor by which the timed and drawn pictures are smaller than a middle size."""


WHOLE = Extent(
    keep=("70%", "50%", "30%", "20%", "10%", "5%"),
    repairs=("none", "quick"),
    views=VIEW_COUNTS.compared,
    shrink=1,
)
QUICK = Extent(keep=("50%", "20%", "5%"), repairs=("none",), views=4, shrink=2)

DENSE = "dense"
"""Key and method of the dense scene."""

RESULTS = {"json": "tradeoff.json", "page": "tradeoff.html"}
"""File names of the results."""


@dataclass(frozen=True)
class Setting:
    """A way to make a scene smaller: count, repair and method."""

    count: int
    repair: Repair = "none"
    by: str = "merge"


@dataclass(frozen=True)
class ImageMetrics:
    """Means over views: PSNR in dB, and SSIM."""

    psnr: float
    ssim: float


class Speed(NamedTuple):
    """Frame time of the dense scene divided by that of a point: median and quartiles over views."""

    median: float
    low: float
    high: float


@dataclass(frozen=True)
class Point:
    """The measurement of one setting."""

    key: str
    """Short name, unique in a table and valid in a file name: ``dense``, ``10pct``,
    ``10pct_quick``."""
    label: str
    """Name to show: ``10 %, repaired (quick)``."""
    command: str
    """The exact command that produces the scene; empty for the dense one."""
    by: str
    """Pruning method; ``dense`` for the dense scene."""
    share: float
    """Number of Gaussians as a share of the dense scene's."""
    gaussians: int
    repair: str
    """Kind of repair, see :data:`Repair`."""
    bytes: int
    """Size of the PLY."""
    against_dense: ImageMetrics
    """Quality against renders of the dense scene, as reported by every command
    (:mod:`~pointsplat_ns.pipeline.quality`); the PSNR of the dense scene is infinite."""
    against_photos: ImageMetrics | None
    """Quality against held-out photos; None without photos."""
    speed: Speed
    frame_ms: float
    """Frame time, ms: the dense scene's time at the start, divided by the median speed, so that
    points stay comparable when the machine slows down."""
    fill: float
    """Mean number of Gaussians that viewers draw per pixel."""
    seconds: float
    """Duration of making the scene."""
    others_cores: float | None = None
    """Number of cores that other programs used during timing; None if unknown."""


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
    """Number and size of the judge's views, as text."""
    width: int
    height: int
    """Size of the pictures, in pixels; the most common one, if there are several."""
    points: tuple[Point, ...]
    notes: tuple[str, ...]
    """Notes for the reader, such as on a busy machine."""
    recommended: str
    """``key`` of the recommended point."""
    why: str
    """Reason for the recommendation, as text."""
    other_sizes: tuple[ImageSize, ...] = ()
    """Sizes of the pictures that are not of the most common one."""

    def point(self, key: str) -> Point:
        """The point with a key. Raises KeyError if there is no such point."""
        return {point.key: point for point in self.points}[key]


def write_points(found: Tradeoff, folder: Path) -> None:
    """Write all points as JSON."""
    points = [
        {**dataclasses.asdict(point), "speed": point.speed._asdict()} for point in found.points
    ]
    write_json({**dataclasses.asdict(found), "points": points}, folder / RESULTS["json"])
