"""The cheapest scene that meets targets, found by search: how many Gaussians, which SH degree, and whether to repair.

With a quality to reach, the cheapest is the smallest file that reaches it. Each way (an SH degree and a repair) has its
smallest count that does; quality rises with the logarithm of the count nearly in a straight line, so a few tries find
it to within :data:`PRECISION`. A way whose largest count that would still be cheaper falls short is given up after one
try. Limits of time and size are then checked on what was found: more Gaussians would only be slower and larger.

With limits only, the cheapest would be one Gaussian; what is found is the best quality within them.

Sizes are those of the files of the format that is asked for. Where only writing a scene tells its size, counts are
guessed from the dense scene's file, and corrected by what the files of scenes weigh.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass, replace

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.pruning import ply_bytes, resolve_keep
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.tradeoff.settings import Setting
from pointsplat_ns.tradeoff.walk import Plan

PRECISION = 1.1
"""The search of a way ends when a count that meets the targets is at most this factor from one that does not."""

SIZE_CLOSE, SIZE_TRIES = 0.95, 3
"""A file whose size only writing tells is large enough at this share of the limit; and so many counts are tried."""

FEWEST = 1e-3
"""Share of the Gaussians below which no scene is tried for a limit of time: almost nothing is left to be drawn."""


@dataclass(frozen=True)
class Targets:
    """What a scene has to meet.

    Raises:
        BudgetError: if there is none, or one is not a positive number.
    """

    db: float | None = None
    """Least PSNR against the dense scene's renders, dB, the mean over views."""
    ms: float | None = None
    """Longest time of a frame, milliseconds."""
    mb: float | None = None
    """Largest file, in units of 10^6 bytes."""

    def __post_init__(self) -> None:
        given = {"--target-db": self.db, "--target-ms": self.ms, "--target-mb": self.mb}
        for name, value in given.items():
            if value is not None and not 0 < value < math.inf:
                raise BudgetError(f"{name} is {value:g}; expected a positive number")
        if all(value is None for value in given.values()):
            raise BudgetError(f"no target is given; expected one of {', '.join(given)}")

    def missed(self, point: Point) -> list[str]:
        """What of the targets a point does not meet, in words; empty if it meets all."""
        words = []
        if self.db is not None and point.against_dense.psnr < self.db:
            words.append(f"{point.against_dense.psnr:.2f} dB where {self.db:g} are wanted")
        if self.ms is not None and point.frame_ms > self.ms:
            words.append(f"{point.frame_ms:.3g} ms a frame where {self.ms:g} are allowed")
        if self.mb is not None and point.bytes > 1e6 * self.mb:
            words.append(f"{point.bytes / 1e6:.2f} MB where {self.mb:g} are allowed")
        return words


def targets_of(
    db: float | None,
    ms: float | None,
    mb: float | None,
    keep: object = None,
    sh: str = "all",
    clean: bool = False,
    seconds: float | None = None,
) -> Targets | None:
    """Targets of which any may be missing; None if all are.

    Args:
        db: least PSNR, dB; see :class:`Targets`.
        ms: longest time of a frame, milliseconds.
        mb: largest file, in units of 10^6 bytes.
        keep: this and the others are options of ``compact`` that say what the search decides.
        sh: as above.
        clean: as above.
        seconds: as above.

    Raises:
        BudgetError: if a target means nothing, or such an option was given beside one.
    """
    if db is ms is mb is None:
        return None
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
    """What the search found."""

    setting: Setting
    point: Point
    why: str
    """One line of text: what it meets at what cost, and what the next one tried would have missed."""


class Search:
    """Searches for the cheapest scene that meets targets.

    Args:
        targets: what to meet.
        plan: what may be tried; only the first method is.
        measure: from a setting to its point; the same each time.
        cut_psnr: as for :func:`~pointsplat_ns.tradeoff.walk.walk`.
        size: of a file, bytes, by count and SH degree; an estimate where only writing a scene tells it. By default that
            of a PLY.
        exact: whether files give scenes back as they are, as a PLY does.
    """

    def __init__(
        self,
        targets: Targets,
        plan: Plan,
        measure: Callable[[Setting], Point],
        cut_psnr: Callable[[int], float],
        size: Callable[[int, int], int] = ply_bytes,
        exact: bool = True,
    ):
        self.targets, self.plan = targets, plan
        self._size, self._exact = size, exact
        self.tried: dict[Setting, Point] = {}
        self._measure, self._cut_psnr = measure, cut_psnr
        self._slope: float | None = None  # dB for each e-fold of the count, as seen in the way before

    def run(self) -> Found:
        """Search.

        Raises:
            BudgetError: if no scene meets all targets; the text says which one is the obstacle, and what is reachable.
        """
        return self._smallest() if self.targets.db is not None else self._best()

    def so_far(self) -> Found | None:
        """The cheapest of what was tried that meets all targets, if the search was interrupted; None if none does."""
        meeting = {s: point for s, point in self.tried.items() if not self.targets.missed(point)}
        if not meeting:
            return None
        if self.targets.db is not None:
            best = min(meeting, key=lambda setting: meeting[setting].bytes)
        else:
            best = max(meeting, key=lambda setting: meeting[setting].against_dense.psnr)
        found = self._found(best)
        return replace(found, why=f"{found.why}; the search was interrupted, and might have found a better one")

    def _point(self, setting: Setting) -> Point:
        if setting not in self.tried:
            self.tried[setting] = self._measure(setting)
        return self.tried[setting]

    def _way(self, degree: int, repair: int = 0) -> Setting:
        return Setting(self.plan.count, degree, self.plan.repairs[repair], self.plan.methods[0])

    def _smallest(self) -> Found:
        """The smallest file that reaches the wanted quality."""
        wanted = self.targets.db
        assert wanted is not None
        ends: list[Setting] = []  # the smallest that reaches it, of each way
        best: Setting | None = None
        size = math.inf  # of its file
        repair = self.plan.repairs[0]

        def attempt(way: Setting) -> bool:
            nonlocal best, size
            end = self._reaching(way, wanted, self._most(way, math.inf if best is None else size))
            if end is None:
                return False
            ends.append(end)
            point = self._point(end)
            if self.targets.missed(point) or point.bytes >= size:
                return False
            best, size = end, point.bytes
            return True

        for index, name in enumerate(self.plan.repairs):
            if attempt(self._way(self.plan.sh_degree, index)):
                repair = name
        for degree in reversed(range(self.plan.sh_degree)):
            if self._cut_psnr(degree) <= wanted:
                break
            attempt(replace(self._way(degree), repair=repair))
        if best is None:
            raise BudgetError(self._obstacle(ends))
        return self._found(best)

    def _reaching(self, way: Setting, wanted: float, most: int) -> Setting | None:
        """The setting of a way with the fewest Gaussians, at most ``most``, that reaches a PSNR; None if none does."""

        def margin(count: int) -> float:
            if (
                self._exact
                and count == self.plan.count
                and way.repair == "none"
                and way.sh_degree == self.plan.sh_degree
            ):
                return math.inf  # the dense scene itself
            return self._point(replace(way, count=count)).against_dense.psnr - wanted

        if most < 1:
            return None
        first = most if most < self.plan.count else resolve_keep(self.plan.count, 0.3)
        high, low = first, 0
        while margin(high) < 0:
            if high >= most:
                return None
            low, high = high, min(most, 2 * high)
        _, fewest, self._slope = _crossing(low, high, margin, self._slope)
        return replace(way, count=fewest)

    def _best(self) -> Found:
        """The best quality within the limits."""
        best: Setting | None = None
        repair = self.plan.repairs[0]
        for index, name in enumerate(self.plan.repairs):
            end = self._within(self._way(self.plan.sh_degree, index))
            if best is None or self._psnr(end) > self._psnr(best):
                best, repair = end, name
        assert best is not None
        for degree in reversed(range(self.plan.sh_degree)):
            if self._cut_psnr(degree) <= self._psnr(best):
                break
            end = self._within(replace(self._way(degree), repair=repair))
            best = end if self._psnr(end) > self._psnr(best) else best
        return self._found(best)

    def _within(self, way: Setting) -> Setting:
        """The setting of a way with the most Gaussians that is within the limits of time and size.

        Raises:
            BudgetError: if none is.
        """
        n, limit = self.plan.count, self.targets.ms
        high = n if self.targets.mb is None else self._fitting(way, math.floor(1e6 * self.targets.mb))
        if limit is None:
            return replace(way, count=high)

        def margin(count: int) -> float:
            return self._point(replace(way, count=count)).frame_ms / limit - 1  # above 0 where it is too slow

        if margin(high) <= 0:
            return replace(way, count=high)
        low = max(1, round(high / 4))
        while margin(low) > 0:
            if low <= FEWEST * n or low == 1:
                point = self._point(replace(way, count=low))
                raise BudgetError(
                    f"no scene meets --target-ms {limit:g}: {point.gaussians:,} Gaussians still take "
                    f"{point.frame_ms:.3g} ms a frame at this size of the image"
                )
            high, low = low, max(1, round(low / 4))
        return replace(way, count=_crossing(low, high, margin)[0])

    def _most(self, way: Setting, size: float) -> int:
        """The most Gaussians of a way whose file should be smaller than ``size`` bytes; 0 if none is."""
        if size == math.inf:
            return self.plan.count
        counts = range(1, self.plan.count + 1)
        return bisect_left(counts, size, key=lambda count: self._size(count, way.sh_degree))

    def _fitting(self, way: Setting, limit: int) -> int:
        """The most Gaussians of a way whose file has at most ``limit`` bytes, nearly.

        Raises:
            BudgetError: if not even one fits.
        """
        fits, tries, count = 0, 0, self._most(way, limit + 1)
        while count > fits:
            tries += 1
            expected = self._size(count, way.sh_degree)
            size = self._point(replace(way, count=count)).bytes
            if size <= limit:
                fits = count
                if size == expected or size >= SIZE_CLOSE * limit or count == self.plan.count:
                    return fits
            if fits and tries >= SIZE_TRIES:
                return fits
            closer = self._most(way, 0.99 * limit * expected / size)
            count = closer if size <= limit else min(closer, count - 1)
        if not fits:
            raise BudgetError(
                f"--target-mb is {limit / 1e6:g}, too small for one Gaussian of SH degree {way.sh_degree}; expected at "
                f"least {self._size(1, way.sh_degree) / 1e6:g}"
            )
        return fits

    def _psnr(self, setting: Setting) -> float:
        return self._point(setting).against_dense.psnr

    def _found(self, setting: Setting) -> Found:
        point = self._point(setting)
        time = "" if math.isnan(point.frame_ms) else f"{point.frame_ms:.3g} ms a frame, "
        figures = (
            f"{point.against_dense.psnr:.2f} dB against the dense scene's renders, {time}{point.bytes / 1e6:.2f} MB, "
            f"{point.gaussians:,} Gaussians"
        )
        why = f"{point.label}: {figures}; {len(self.tried)} scenes tried"
        failed = [other for other in self.tried.values() if self.targets.missed(other)]
        if self.targets.db is not None:
            cheaper = [other for other in failed if other.bytes < point.bytes]
            if cheaper:
                other = max(cheaper, key=lambda p: (p.bytes, p.against_dense.psnr))
                why += f"; the next cheaper, {other.label}, has {', '.join(self.targets.missed(other))}"
        else:
            better = [other for other in failed if other.against_dense.psnr > point.against_dense.psnr]
            if better:
                other = min(better, key=lambda p: p.against_dense.psnr)
                why += f"; the next better, {other.label}, has {', '.join(self.targets.missed(other))}"
        return Found(setting, point, why)

    def _obstacle(self, ends: list[Setting]) -> str:
        """Why no scene meets all targets, given the smallest of each way that reach the wanted quality."""
        if not ends:
            best = max(self.tried.values(), key=lambda point: point.against_dense.psnr)
            return (
                f"no scene reaches --target-db {self.targets.db:g} in this format: the best tried has "
                f"{best.against_dense.psnr:.2f} dB ({best.label})"
            )
        points = [self._point(end) for end in ends]
        size, ms = min(p.bytes for p in points) / 1e6, min(p.frame_ms for p in points)
        obstacles = []
        if self.targets.mb is not None and size > self.targets.mb:
            obstacles.append(f"takes {size:.2f} MB, over --target-mb {self.targets.mb:g}")
        if self.targets.ms is not None and ms > self.targets.ms:
            obstacles.append(f"takes {ms:.3g} ms a frame, over --target-ms {self.targets.ms:g}")
        obstacle = " and ".join(obstacles) or "is either too large or too slow"
        limits = replace(self.targets, db=None)
        within = Search(limits, self.plan, self._point, self._cut_psnr, self._size, self._exact).run().point
        return (
            f"no scene meets all targets: what reaches {self.targets.db:g} dB {obstacle}; the best within the limits "
            f"has {within.against_dense.psnr:.2f} dB ({within.label}), so ask for less than that"
        )


def _crossing(
    low: int, high: int, margin: Callable[[int], float], slope: float | None = None
) -> tuple[int, int, float | None]:
    """Neighbouring counts, within :data:`PRECISION`, between which a margin rises through 0: below at the first (which
    may be 0, that holds nothing), not below at the second. For a limit, the first is the largest that is within it.

    Args:
        low: a count at which it is below; 0 if none is known.
        high: a count at which it is not.
        margin: of a count.
        slope: how much a margin of this kind was seen to rise while counts rise e-fold.

    Returns:
        The two, and the slope seen last.
    """
    enough = [(high, margin(high))]  # counts and margins that are not below 0, descending
    while high > max(low, 1) * PRECISION and high - low > 1:
        if len(enough) > 1 and low == 0:
            slope = _slope(enough[-1], enough[-2])
        guess = _beyond(*enough[-1], slope) if low == 0 else _between((low, margin(low)), enough[-1])
        middle = min(high - 1, max(low + 1, round(guess)))
        value = margin(middle)
        if value < 0:
            low = middle
        else:
            high = middle
            enough.append((middle, value))
    return low, high, _slope((low, margin(low)), enough[-1]) if low else slope


def _slope(fewer: tuple[int, float], more: tuple[int, float]) -> float | None:
    """How much a margin rises from one count to another for each e-fold; None if it does not, or has no bound."""
    slope = (more[1] - fewer[1]) / math.log(more[0] / fewer[0])
    return slope if 0 < slope < math.inf else None


def _between(below: tuple[int, float], above: tuple[int, float]) -> float:
    """The count between two at which the margin is 0, if it is a straight line over the logarithm of the count, and a
    little more, so that it is likely to be enough; away from both ends, so that each try narrows the gap."""
    (fewer, lack), (more, spare) = below, above
    share = 0.05 - lack / (spare - lack) if math.isfinite(spare - lack) else 0.5
    return fewer * (more / fewer) ** min(0.85, max(0.15, share))


def _beyond(count: int, spare: float, slope: float | None) -> float:
    """A count below one that has a margin to spare: a little below where a straight line of this slope has none; a
    quarter where the slope is not known."""
    if slope is None or not math.isfinite(spare):
        return count / 4
    return max(count / 16, 0.95 * count * math.exp(-spare / slope))
