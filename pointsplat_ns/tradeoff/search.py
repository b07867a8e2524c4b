"""Searches for the cheapest scene that meets targets: number of Gaussians, SH degree, and repair.

A *way* is an SH degree and a repair. With a target of PSNR, the cheapest scene is the smallest file that reaches it:
the smallest count of each way is searched, and ways with larger files than the best so far are skipped. Limits of time
and size are checked afterwards. With limits only, the result is the best quality within them: the largest count of each
way within the limits.
"""

from __future__ import annotations

import functools
import math
import time
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace

from pointsplat_ns.compression.budget_search import FIRST_SHARE, find_count, find_size
from pointsplat_ns.compression.compact import as_compacted
from pointsplat_ns.compression.compacted import Compacted
from pointsplat_ns.compression.quality import decibels, through_file
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.io.formats import format_to_write
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.metrics import MOST_PSNR
from pointsplat_ns.pruning import cut_sh, ply_bytes, resolve_keep
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.system.quantities import counted
from pointsplat_ns.tradeoff.making import Subject
from pointsplat_ns.tradeoff.measuring import Measurer, busy_note
from pointsplat_ns.tradeoff.points import Point, Repair, Setting

PRECISION = 1.1
"""Largest ratio of a count that meets a target to the next one that misses it: coarse, because each try makes, repairs
and renders a scene."""


@dataclass(frozen=True)
class Targets:
    """Targets of a scene. Raises BudgetError if there is no target, or one is not a positive number or above what
    differs from no error."""

    db: float | None = None
    """Least PSNR against the dense scene's renders, over the pixels that it covers, dB."""
    ms: float | None = None
    """Longest time of a frame, milliseconds."""
    mb: float | None = None
    """Largest file, in units of 10^6 bytes."""

    def __post_init__(self) -> None:
        given = {"--target-db": self.db, "--target-ms": self.ms, "--target-mb": self.mb}
        for name, value in given.items():
            if value is not None and not 0 < value < math.inf:
                raise BudgetError(f"{name} is {value:g}; expected a positive number")
        if self.db is not None and self.db > MOST_PSNR:
            raise BudgetError(
                f"--target-db is {self.db:g}; no smaller scene reaches it, expected at most {MOST_PSNR:g}"
            )
        if all(value is None for value in given.values()):
            raise BudgetError(f"no target is given; expected one of {', '.join(given)}")

    def __str__(self) -> str:
        limits = [] if self.db is None else [f"at least {self.db:g} dB"]
        limits += [] if self.ms is None else [f"at most {self.ms:g} ms a frame"]
        limits += [] if self.mb is None else [f"at most {bytes_text(1e6 * self.mb)}"]
        return ", ".join(limits)

    def missed(self, point: Point) -> list[str]:
        """Text on each target that a point misses; empty if it meets all."""
        words = []
        if self.db is not None and point.against_dense.psnr < self.db:
            words.append(f"{point.against_dense.psnr:.2f} dB, less than {self.db:g} dB")
        if self.ms is not None and point.frame_ms > self.ms:
            words.append(f"{point.frame_ms:.3g} ms a frame, more than {self.ms:g} ms")
        if self.mb is not None and point.bytes > 1e6 * self.mb:
            words.append(f"{bytes_text(point.bytes)}, more than {bytes_text(1e6 * self.mb)}")
        return words


def targets_of(
    db: float | None,
    ms: float | None,
    mb: float | None,
    keep: object = None,
    sh: str = "all",
    clean: bool = False,
    seconds: float | None = None,
    photos: bool = False,
) -> Targets | None:
    """Targets from options that may be missing; None if all are missing. Raises BudgetError if a target is invalid, or
    ``photos`` or an option that the search decides (keep, sh, clean, seconds) is given with a target."""
    if db is ms is mb is None:
        return None
    if photos:
        raise BudgetError("a search for targets renders the dense scene alone; expected targets or photos, not both")
    decided = {"keep": keep is not None, "sh": sh != "all", "clean": clean, "seconds": seconds is not None}
    names = [name for name, given in decided.items() if given]
    if names:
        raise BudgetError(
            f"{', '.join(names)} cannot be given with a target: how many Gaussians and SH bands are kept, and how they "
            "are repaired, is decided by what the scene needs"
        )
    return Targets(db, ms, mb)


@dataclass(frozen=True)
class Found:
    """The setting that a search found, and a line of text with its figures and those of the next cheaper one."""

    setting: Setting
    point: Point
    why: str


class TargetSearch:
    """Searches for the cheapest scene that meets targets.

    Args:
        targets: the targets.
        whole: the setting that keeps all Gaussians and SH bands, with the method to use.
        repairs: the repairs to try.
        measure: from a setting to its point; deterministic.
        cut_psnr: from an SH degree to the PSNR in dB of the dense scene's renders without the bands above, against all
            bands.
        where: text on the views that points are judged in.
        size: bytes of a file by count and SH degree, or an estimate; by default of a PLY.
        exact: whether files keep scenes exactly, as a PLY does.
    """

    def __init__(
        self,
        targets: Targets,
        whole: Setting,
        repairs: tuple[Repair, ...],
        measure: Callable[[Setting], Point],
        cut_psnr: Callable[[int], float],
        where: str,
        size: Callable[[int, int], int] = ply_bytes,
        exact: bool = True,
    ):
        self.targets, self.whole, self.repairs, self.where = targets, whole, repairs, where
        self.tried: dict[Setting, Point] = {}
        self._measure, self._cut_psnr, self._size, self._exact = measure, cut_psnr, size, exact
        self._best: Setting | None = None
        self._slope: float | None = None  # dB for each e-fold of the count, from the previous way

    def run(self) -> Found:
        """Search. Raises BudgetError if no scene meets all targets; the text tells the obstacle."""
        for repair in self.repairs:
            self._try(replace(self.whole, repair=repair))
        repair = self.repairs[0] if self._best is None else self._best.repair
        for degree in reversed(range(self.whole.sh_degree)):
            if self._cut_psnr(degree) <= self._wanted:
                break
            self._try(replace(self.whole, repair=repair, sh_degree=degree))
        if self._best is None:
            assert self.targets.db is not None, "limits alone are met or refused"
            raise BudgetError(self._obstacle(self.targets.db))
        return self._found(self._best)

    def so_far(self) -> Found | None:
        """The cheapest tried scene that meets all targets, for an interrupted search; None if no scene does."""
        meeting = [setting for setting, point in self.tried.items() if not self.targets.missed(point)]
        if not meeting:
            return None
        found = self._found(min(meeting, key=self._cost))
        return replace(found, why=f"{found.why}; the search was interrupted, and might have found a better one")

    @property
    def _wanted(self) -> float:
        """Least PSNR in dB of the dense scene without some SH bands for a try of that SH degree."""
        if self.targets.db is not None:
            return self.targets.db
        return -math.inf if self._best is None else self._point(self._best).against_dense.psnr

    def _cost(self, setting: Setting) -> float:
        """The cost to minimise: the size of the file, or without a target of PSNR, the negative PSNR."""
        point = self._point(setting)
        return -point.against_dense.psnr if self.targets.db is None else point.bytes

    def _try(self, way: Setting) -> None:
        """Search along a way, and keep the result if it is the best."""
        end = self._within(way) if self.targets.db is None else self._reaching(way, self.targets.db)
        if end is None:
            return
        meets = not self.targets.missed(self._point(end))
        if meets and (self._best is None or self._cost(end) < self._cost(self._best)):
            self._best = end

    def _point(self, setting: Setting) -> Point:
        if setting not in self.tried:
            self.tried[setting] = self._measure(setting)
        return self.tried[setting]

    def _reaching(self, way: Setting, wanted: float) -> Setting | None:
        """The setting of a way with the fewest Gaussians that reaches a PSNR, if its file is smaller than the best so
        far; else None."""

        def psnr(count: int) -> float:
            setting = replace(way, count=count)
            return math.inf if self._exact and setting == self.whole else self._point(setting).against_dense.psnr

        most = self.whole.count if self._best is None else self._most(way, self._point(self._best).bytes)
        if most < 1:
            return None
        first = most if most < self.whole.count else resolve_keep(self.whole.count, FIRST_SHARE)
        found = find_count(psnr, wanted, at_least=True, first=first, most=most, slope=self._slope, precision=PRECISION)
        if found.count is None:
            return None
        self._slope = found.slope
        return replace(way, count=found.count)

    def _within(self, way: Setting) -> Setting:
        """The setting of a way with the most Gaussians within the limits of time and size. Raises BudgetError if there
        is none."""
        count, limit = self._fitting(way), self.targets.ms
        if limit is None:
            return replace(way, count=count)
        least = min(count, max(1, round(1e-3 * self.whole.count)))  # fewer draw almost nothing
        found = find_count(
            lambda count: math.log(self._point(replace(way, count=count)).frame_ms), math.log(limit), at_least=False,
            first=count, most=count, least=least, slope=1.0, precision=PRECISION,
        )  # fmt: skip
        if found.count is None:
            point = self._point(replace(way, count=least))
            raise BudgetError(
                f"no scene meets --target-ms {limit:g}: {point.gaussians:,} Gaussians still take {point.frame_ms:.3g} "
                "ms a frame at this size of the image"
            )
        return replace(way, count=found.count)

    def _fitting(self, way: Setting) -> int:
        """Nearly the largest count of a way whose file is within the limit of size. Raises BudgetError if not even one
        Gaussian fits."""
        if self.targets.mb is None:
            return self.whole.count
        limit = math.floor(1e6 * self.targets.mb)
        count = find_size(
            lambda count: self._point(replace(way, count=count)).bytes, limit, self._most(way, limit + 1),
            self.whole.count,
        )  # fmt: skip
        if count is None:
            raise BudgetError(
                f"--target-mb is {limit / 1e6:g}, too small for one Gaussian of SH degree {way.sh_degree}; expected at "
                f"least {self._size(1, way.sh_degree) / 1e6:g}"
            )
        return count

    def _most(self, way: Setting, size: int) -> int:
        """The largest count of a way with an expected file below ``size`` bytes; 0 if there is none."""
        counts = range(1, self.whole.count + 1)
        return bisect_left(counts, size, key=lambda count: self._size(count, way.sh_degree))

    def _found(self, setting: Setting) -> Found:
        point = self._point(setting)
        time = "" if math.isnan(point.frame_ms) else f"{point.frame_ms:.3g} ms a frame, "
        why = (
            f"{point.label}: {decibels(point.against_dense.psnr)} against the dense scene in {self.where}, "
            f"{time}{bytes_text(point.bytes)}, {point.gaussians:,} Gaussians; {counted(len(self.tried), 'scene')} tried"
        )
        cheaper = [s for s, p in self.tried.items() if self.targets.missed(p) and self._cost(s) < self._cost(setting)]
        if cheaper:
            other = self.tried[max(cheaper, key=lambda s: (self._cost(s), self.tried[s].against_dense.psnr))]
            word = "better" if self.targets.db is None else "cheaper"
            why += f"; the next {word}, {other.label}, has {' and '.join(self.targets.missed(other))}"
        return Found(setting, point, why)

    def _obstacle(self, wanted: float) -> str:
        """Text on the reason why no scene that reaches a PSNR meets all targets."""
        tried = self.tried.values()
        reaching = [point for point in tried if point.against_dense.psnr >= wanted]
        if reaching:
            point = min(reaching, key=lambda point: point.bytes)
            missed = " and ".join(self.targets.missed(point))
            return f"no scene meets all targets: the smallest that reaches {wanted:g} dB ({point.label}) has {missed}"
        best = max(tried, key=lambda point: point.against_dense.psnr)
        psnr = f"{best.against_dense.psnr:.2f} dB in {self.where} ({best.label})"
        return f"no scene reaches --target-db {wanted:g} in this format: the best tried has {psnr}"


def find_scene(
    subject: Subject, targets: Targets, by: str, repairs: tuple[Repair, ...], progress: Progress
) -> Compacted:
    """Find the cheapest scene that meets targets by :class:`TargetSearch`, with a method of pruning and the repairs to
    try, without a folder of measurements: ``compact --target-db``.

    Scenes are judged as commands say it (:mod:`~pointsplat_ns.compression.quality`), after writing and reading them in
    the subject's format. Frames are timed only for a target of time. Ctrl-C ends the search with the cheapest scene
    found so far.

    Raises:
        BudgetError: if no scene meets all targets; the text tells the reachable values.
        SceneError: if no Gaussian can be drawn.
        DataError: if there are no views.
        KeyboardInterrupt: on an interruption before any scene meets all targets.
    """
    start = time.perf_counter()
    dense, timed = subject.dense, targets.ms is not None
    measurer = Measurer(subject, VIEW_COUNTS.compared, progress, timed=timed)

    def measure(setting: Setting) -> Point:
        number = 1 + len(search.tried)
        return measurer.measure(setting, lambda what, share: progress(f"scene {number}: {what}", share))

    kind = format_to_write(subject.suffix)
    size, bytes_of = _estimated(subject), kind.bytes_of
    if bytes_of is not None:
        size = lambda count, degree: bytes_of(count, degree, dense.traits)  # noqa: E731
    where, exact = measurer.judge.where, kind.suffix == ".ply"
    search = TargetSearch(
        targets, Setting(len(dense), dense.sh_degree, by=by), repairs, measure, measurer.cut_psnr, where, size, exact
    )
    interrupted = False
    try:
        if timed:
            measurer.measure_dense(lambda what, share: progress(f"dense scene: {what}", share))
        found = search.run()
    except KeyboardInterrupt:
        so_far, interrupted = search.so_far(), True
        if so_far is None:
            raise
        found = so_far
    if timed:
        measurer.note(busy_note([point.others_cores for point in search.tried.values()]))
    made = measurer.made(found.setting, progress)
    compacted = made.compacted or as_compacted(dense, made.scene, subject.new_views(), made.notes, by)
    notes = tuple(dict.fromkeys((*measurer.notes, *compacted.notes)))
    seconds = time.perf_counter() - start
    return replace(compacted, target=found.why, interrupted=interrupted, notes=notes, seconds=seconds)


def _estimated(subject: Subject) -> Callable[[int, int], int]:
    """Estimate of a file's size in bytes by count and SH degree, from the mean bytes of the dense scene's Gaussians."""

    @functools.cache
    def whole(degree: int) -> int:
        return through_file(cut_sh(subject.dense, degree), subject.suffix)[0]

    return lambda count, degree: max(1, whole(degree) * count // len(subject.dense))
