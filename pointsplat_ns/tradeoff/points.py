"""What was measured of a scene: one point for each way of making it smaller."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple


@dataclass(frozen=True)
class Quality:
    """Means over views: PSNR in dB, SSIM, and LPIPS, which is None where its weights are not at hand."""

    psnr: float
    ssim: float
    lpips: float | None = None


@dataclass(frozen=True)
class Point:
    """One way of making a scene smaller, measured."""

    key: str
    """Short name, unique in a sweep and fit for a file's name: ``dense``, ``10pct_sh3``, ``10pct_sh3_quick``."""
    label: str
    """The same for people: ``10 %, repaired for 12 s``."""
    command: str
    """The exact command that produces the scene; empty for the dense one."""
    by: str
    """The method of pruning; ``dense`` for the scene as it is."""
    share: float
    """Share of the Gaussians kept."""
    gaussians: int
    sh_degree: int
    repair: str
    """``none``, or what repaired it: ``refiner``, ``quick``, ``thorough``."""
    bytes: int
    """Size of the file."""
    against_dense: Quality
    """Against renders of the dense scene. Its PSNR is infinite for the dense scene itself."""
    against_photos: Quality | None
    """Against held-out photos; None where there are none."""
    frame_ms: float
    """Time of one frame, in milliseconds: that of the dense scene when the sweep began, times the median over views of
    the share of it that a frame takes. Both were drawn in turn, so that points that are measured while the machine is
    slower compare with others."""
    frame_ms_low: float
    frame_ms_high: float
    """The same with the quartiles over views."""
    seconds: float
    """Time that making it took."""
    peak_bytes: int | None = None
    """Peak memory of the process that made it; None where it was not measured."""
    others_cores: float | None = None
    """Cores that other programs kept busy while frames were timed; None where it was not measured."""
    clock_ms: float | None = None
    """Median time of one frame over views, in milliseconds, as the clock said it when this point was measured; None
    where it was not measured."""
    drawn: str = "exact"
    """How its frames were drawn, for pictures and times: ``exact``, ``fast``, ``half``."""


class Speed(NamedTuple):
    """How many times as fast as the dense scene frames are drawn: median over views, and quartiles.

    Example:
        >>> print(Speed(2.13, 1.94, 2.31))
        2.1 times as fast (1.9 to 2.3)
    """

    median: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.median:.2g} times as fast ({self.low:.2g} to {self.high:.2g})"


def speed_of(point: Point, dense: Point) -> Speed:
    """How many times as fast as the dense scene a point is drawn."""
    return Speed(*(dense.frame_ms / ms for ms in (point.frame_ms, point.frame_ms_high, point.frame_ms_low)))


@dataclass(frozen=True)
class Tradeoff:
    """Every point that was measured of a scene. The first is the dense scene.

    Example:
        >>> import tempfile
        >>> import pointsplat_ns as ps
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     ps.save(ps.example_room()[::200][:300], f"{folder}/room.ply")
        ...     options = {"points": 2, "views": 2, "resolution": "64x48", "drawn": ("exact",)}
        ...     found = ps.measure_tradeoff(f"{folder}/room.ply", f"{folder}/trade", **options)
        >>> [point.key for point in found.points], found.point("10pct_sh1").gaussians
        (['dense', '10pct_sh1'], 30)
    """

    scene: str
    """Name of the scene."""
    machine: str
    """Processor, number of threads, device and version of torch, as text."""
    views_origin: str
    """Where the views came from."""
    width: int
    height: int
    """Size of the views, in pixels."""
    points: tuple[Point, ...]
    notes: tuple[str, ...] = ()
    """Lines of text for the reader: that the machine was busy and times are not to be trusted, that LPIPS is
    missing."""
    times_trusted: bool = True
    """Whether other programs left the machine alone while frames were timed."""
    recommended: str = ""
    """``key`` of the recommended point, or of the one found for targets."""
    why: str = ""
    """One line of text: what it was recommended or found for, and at what cost."""

    def point(self, key: str) -> Point:
        """The point with a key.

        Raises:
            KeyError: if there is none.
        """
        return {point.key: point for point in self.points}[key]


def picture_path(folder: Path, view: int, what: str) -> Path:
    """Where the picture of a view lies.

    Args:
        folder: the folder of the sweep.
        view: the view's number, from 0.
        what: a point's ``key``, or ``photo``.
    """
    return folder / "pictures" / f"{view:02d}_{what}.png"


def flight_path(folder: Path, key: str) -> Path:
    """Where a point's scene lies, as the page shows it to fly through, if it is small enough for that.

    Args:
        folder: the folder of the sweep.
        key: the point's.
    """
    return folder / "scenes" / f"{key}.json"
