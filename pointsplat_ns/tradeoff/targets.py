"""Searches for the cheapest scene that meets targets: number of Gaussians, SH degree, and repair.

A *way* is an SH degree and a repair. With a target of PSNR, the cheapest scene is the smallest file that reaches it:
the smallest count of each way is searched, and ways with larger files than the best so far are skipped. Limits of time
and size are checked afterwards. With limits only, the result is the best quality within them: the largest count of each
way within the limits.

Sizes are those of files of the requested format. For formats without a formula, counts are first estimated from the
dense scene's file.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace

from pointsplat_ns.compression.budget_search import BUDGETS, find_count
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.metrics import MOST_PSNR
from pointsplat_ns.pruning import ply_bytes, resolve_keep
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import Setting
from pointsplat_ns.tradeoff.walk import Plan


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

    def missed(self, point: Point) -> list[str]:
        """Text on each target that a point misses; empty if it meets all."""
        words = []
        if self.db is not None and point.against_dense.psnr < self.db:
            words.append(f"{point.against_dense.psnr:.2f} dB where {self.db:g} are wanted")
        if self.ms is not None and point.frame_ms > self.ms:
            words.append(f"{point.frame_ms:.3g} ms a frame where {self.ms:g} are allowed")
        if self.mb is not None and point.bytes > 1e6 * self.mb:
            words.append(f"{bytes_text(point.bytes)} where {self.mb:g} are allowed")
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
    an option of ``compact`` that the search decides (keep, sh, clean, seconds), or ``photos``, is given with a
    target."""
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
    """The result of the search."""

    setting: Setting
    point: Point
    why: str
    """One line of text: the figures of the scene, and the targets that the next cheaper scene misses."""


class TargetSearch:
    """Searches for the cheapest scene that meets targets.

    Args:
        targets: the targets.
        plan: settings to try; only its first method is used.
        measure: from a setting to its point; deterministic.
        cut_psnr: as for :func:`~pointsplat_ns.tradeoff.walk.measure_walk`.
        where: text on the views that points are measured in.
        size: bytes of a file by count and SH degree, or an estimate; by default of a PLY.
        exact: whether files keep scenes exactly, as a PLY does.
    """

    def __init__(
        self,
        targets: Targets,
        plan: Plan,
        measure: Callable[[Setting], Point],
        cut_psnr: Callable[[int], float],
        where: str,
        size: Callable[[int, int], int] = ply_bytes,
        exact: bool = True,
    ):
        self.targets, self.plan, self.where = targets, plan, where
        self.tried: dict[Setting, Point] = {}
        self._measure, self._cut_psnr, self._size, self._exact = measure, cut_psnr, size, exact
        self._ends: list[Setting] = []  # the result of each way
        self._best: Setting | None = None
        self._slope: float | None = None  # dB for each e-fold of the count, from the previous way

    def run(self) -> Found:
        """Search. Raises BudgetError if no scene meets all targets; the text tells the obstacle and the reachable
        values."""
        plan, by = self.plan, self.plan.methods[0]
        for repair in plan.repairs:
            self._try(Setting(plan.count, plan.sh_degree, repair, by))
        repair = plan.repairs[0] if self._best is None else self._best.repair
        for degree in reversed(range(plan.sh_degree)):
            if self._cut_psnr(degree) <= self._wanted:
                break
            self._try(Setting(plan.count, degree, repair, by))
        if self._best is None:
            raise BudgetError(self._obstacle())
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
        self._ends.append(end)
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
        whole = Setting(self.plan.count, self.plan.sh_degree, by=way.by)

        def psnr(count: int) -> float:
            setting = replace(way, count=count)
            return math.inf if self._exact and setting == whole else self._point(setting).against_dense.psnr

        most = self.plan.count if self._best is None else self._most(way, self._point(self._best).bytes)
        if most < 1:
            return None
        first = most if most < self.plan.count else resolve_keep(self.plan.count, BUDGETS.first_share)
        found = find_count(
            psnr, wanted, at_least=True, first=first, most=most, slope=self._slope, settings=BUDGETS.repaired
        )
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
        least = min(count, max(1, round(1e-3 * self.plan.count)))  # fewer draw almost nothing
        found = find_count(
            lambda count: math.log(self._point(replace(way, count=count)).frame_ms), math.log(limit), at_least=False,
            first=count, most=count, least=least, slope=1.0, settings=BUDGETS.repaired,
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
            return self.plan.count
        limit = math.floor(1e6 * self.targets.mb)
        found = find_count(
            lambda count: math.log(self._point(replace(way, count=count)).bytes), math.log(max(limit, 1)),
            at_least=False, first=self._most(way, limit + 1), most=self.plan.count, slope=1.0, settings=BUDGETS.size,
        )  # fmt: skip
        if found.count is None:
            raise BudgetError(
                f"--target-mb is {limit / 1e6:g}, too small for one Gaussian of SH degree {way.sh_degree}; expected at "
                f"least {self._size(1, way.sh_degree) / 1e6:g}"
            )
        return found.count

    def _most(self, way: Setting, size: int) -> int:
        """The largest count of a way with an expected file below ``size`` bytes; 0 if there is none."""
        counts = range(1, self.plan.count + 1)
        return bisect_left(counts, size, key=lambda count: self._size(count, way.sh_degree))

    def _found(self, setting: Setting) -> Found:
        point = self._point(setting)
        time = "" if math.isnan(point.frame_ms) else f"{point.frame_ms:.3g} ms a frame, "
        why = (
            f"{point.label}: {point.against_dense.psnr:.2f} dB against the dense scene's renders in {self.where}, "
            f"{time}{bytes_text(point.bytes)}, {point.gaussians:,} Gaussians; {len(self.tried)} scenes tried"
        )
        cheaper = [s for s, p in self.tried.items() if self.targets.missed(p) and self._cost(s) < self._cost(setting)]
        if cheaper:
            other = self.tried[max(cheaper, key=lambda s: (self._cost(s), self.tried[s].against_dense.psnr))]
            word = "better" if self.targets.db is None else "cheaper"
            why += f"; the next {word}, {other.label}, has {', '.join(self.targets.missed(other))}"
        return Found(setting, point, why)

    def _obstacle(self) -> str:
        """Text on the reason why no scene meets all targets."""
        if not self._ends:
            best = max(self.tried.values(), key=lambda point: point.against_dense.psnr)
            return (
                f"no scene reaches --target-db {self.targets.db:g} in this format: the best tried has "
                f"{best.against_dense.psnr:.2f} dB in {self.where} ({best.label})"
            )
        points = [self._point(end) for end in self._ends]
        size, ms = min(p.bytes for p in points), min(p.frame_ms for p in points)
        obstacles = []
        if self.targets.mb is not None and size > 1e6 * self.targets.mb:
            obstacles.append(f"takes {bytes_text(size)}, over --target-mb {self.targets.mb:g}")
        if self.targets.ms is not None and ms > self.targets.ms:
            obstacles.append(f"takes {ms:.3g} ms a frame, over --target-ms {self.targets.ms:g}")
        obstacle = " and ".join(obstacles) or "is either too large or too slow"
        limits = replace(self.targets, db=None)
        within = (
            TargetSearch(limits, self.plan, self._point, self._cut_psnr, self.where, self._size, self._exact)
            .run()
            .point
        )
        return (
            f"no scene meets all targets: what reaches {self.targets.db:g} dB {obstacle}; the best within the limits "
            f"has {within.against_dense.psnr:.2f} dB ({within.label}), so ask for less than that"
        )
