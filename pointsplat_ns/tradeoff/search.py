"""Searches for the cheapest scene that meets targets: number of Gaussians, SH degree, and repair.

A *way* is an SH degree and a repair. With a target of PSNR, the cheapest scene is the smallest file that reaches it:
the smallest count of each way is searched, and ways with larger files than the best so far are skipped. Limits of time
and size are checked afterwards. With limits only, the result is the best quality within them: the largest count of each
way within the limits.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace

from pointsplat_ns.compression.budget_search import BUDGETS, find_count
from pointsplat_ns.errors import BudgetError
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.pruning import ply_bytes, resolve_keep
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import Repair, Setting
from pointsplat_ns.tradeoff.targets import Targets


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
        where: text on the views that points are measured in.
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
        first = most if most < self.whole.count else resolve_keep(self.whole.count, BUDGETS.first_share)
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
        least = min(count, max(1, round(1e-3 * self.whole.count)))  # fewer draw almost nothing
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
            return self.whole.count
        limit = math.floor(1e6 * self.targets.mb)
        found = find_count(
            lambda count: math.log(self._point(replace(way, count=count)).bytes), math.log(max(limit, 1)),
            at_least=False, first=self._most(way, limit + 1), most=self.whole.count, slope=1.0, settings=BUDGETS.size,
        )  # fmt: skip
        if found.count is None:
            raise BudgetError(
                f"--target-mb is {limit / 1e6:g}, too small for one Gaussian of SH degree {way.sh_degree}; expected at "
                f"least {self._size(1, way.sh_degree) / 1e6:g}"
            )
        return found.count

    def _most(self, way: Setting, size: int) -> int:
        """The largest count of a way with an expected file below ``size`` bytes; 0 if there is none."""
        counts = range(1, self.whole.count + 1)
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

    def _obstacle(self, wanted: float) -> str:
        """Text on the reason why no scene that reaches a PSNR meets all targets."""
        tried = self.tried.values()
        reaching = [point for point in tried if point.against_dense.psnr >= wanted]
        if reaching:
            point = min(reaching, key=lambda point: point.bytes)
            missed = ", ".join(self.targets.missed(point))
            return f"no scene meets all targets: the smallest that reaches {wanted:g} dB ({point.label}) has {missed}"
        best = max(tried, key=lambda point: point.against_dense.psnr)
        psnr = f"{best.against_dense.psnr:.2f} dB in {self.where} ({best.label})"
        return f"no scene reaches --target-db {wanted:g} in this format: the best tried has {psnr}"
