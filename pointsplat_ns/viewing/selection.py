"""A scene at the budget of a slider: chosen by a score at once, and merged in the background."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property

from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import keep_usable
from pointsplat_ns.looking.content import thinned
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.pruning import resolve_keep, select
from pointsplat_ns.pruning.coverage import coverage_score
from pointsplat_ns.pruning.merging import Merger


@dataclass(eq=False)
class ReducedScene:
    """A scene at a budget, and the way it was made."""

    scene: Gaussians
    how: str
    """Text on the way it was made, which follows the count."""
    _parts: dict[int, Gaussians] = field(default_factory=dict)

    def part(self, share: float, least: int = 20_000) -> Gaussians:
        """The scene with about a share of its Gaussians, at least ``least``, for moving cameras. They are enlarged to
        cover the same area."""
        count = max(round(len(self.scene) * share), least)
        if count >= len(self.scene):
            return self.scene
        count = 2 ** (count.bit_length() - 1)  # few different counts, so that most parts are made already
        if count not in self._parts:
            self._parts[count] = thinned(self.scene, count)
        return self._parts[count]


class MergingStopped(Exception):
    """Raised in merging for an outdated budget."""


class Selection:
    """A scene at a budget that may change. :meth:`choose` acts at once; after ``rest`` seconds without a new budget, a
    thread merges to the same budget, which gives the scene that ``pointsplat prune`` writes.

    Undrawable Gaussians are left out. ``levels`` are smaller scenes that are there already; each stands for budgets
    near its count. Merging uses the dataset's views of ``source``. ``changed`` is called from any
    thread, with True for a new scene, and with False for new status text alone.
    """

    def __init__(
        self,
        scene: Gaussians,
        source: ViewSource,
        changed: Callable[[bool], None],
        rest: float = 1.0,
        levels: Sequence[Gaussians] = (),
    ):
        self.scene = keep_usable(scene, "the scene")
        """All drawable Gaussians."""
        self.whole = ReducedScene(self.scene, "all")
        """The scene at 100 %."""
        self.current = self.whole
        """The scene at the current budget."""
        self.status = ""
        """Text on the thread's work; empty if it waits."""
        self._merged: dict[int, ReducedScene] = {}
        self._levels = [ReducedScene(level, f"level {n} of the stream") for n, level in enumerate(levels, start=1)]
        self._source, self._report, self._rest = source, changed, rest
        self._wanted = 100
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="merging", daemon=True)
        self._thread.start()

    @property
    def percent(self) -> int:
        """The budget, in percent of the Gaussians."""
        return self._wanted

    def choose(self, percent: int) -> None:
        """Set the budget, 1 to 100 percent of the Gaussians."""
        with self._changed:
            self._wanted = percent = min(max(round(percent), 1), 100)
            self.current, self.status = self._at(percent), ""
            self._changed.notify_all()
        self._report(True)

    def close(self, timeout: float = 5.0) -> None:
        """Stop merging, and wait for it at most ``timeout`` seconds."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _count(self, percent: int) -> int:
        return resolve_keep(len(self.scene), percent / 100)

    def _at(self, percent: int) -> ReducedScene:
        """The best scene at a budget without new merging."""
        if percent == 100:
            return self.whole
        there = self._level(percent) or self._merged.get(percent)
        if there is not None:
            return there
        return ReducedScene(self.scene[select(self._scores, self._count(percent))], "chosen by coverage")

    def _level(self, percent: int) -> ReducedScene | None:
        """The level that has about as many Gaussians as a budget, to a tenth."""
        count = len(self.scene) * percent / 100
        near = [level for level in self._levels if abs(len(level.scene) - count) <= 0.1 * count]
        return min(near, key=lambda level: abs(len(level.scene) - count), default=None)

    def _is_there(self, percent: int) -> bool:
        return percent == 100 or percent in self._merged or self._level(percent) is not None

    @cached_property
    def _scores(self) -> Tensor:
        return coverage_score(self.scene)

    @cached_property
    def _merger(self) -> Merger:
        return Merger(self.scene, self._source.for_merging())

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._closed and self._is_there(self._wanted):
                    self._changed.wait()
                wanted = self._wanted
                self._changed.wait(self._rest)
                if self._closed:
                    return
                if wanted != self._wanted:
                    continue  # after a spurious wake-up the rest is shorter, which does no harm
            try:
                merged = self._merge(wanted)
            except MergingStopped:
                continue
            except (PointSplatError, MemoryError, RuntimeError) as error:
                merged = ReducedScene(self._at(wanted).scene, f"chosen by coverage, because merging failed: {error}")
            with self._changed:
                self._keep(wanted, merged)
                if wanted == self._wanted:
                    self.current, self.status = merged, ""
            self._report(True)

    def _merge(self, percent: int) -> ReducedScene:
        def report(share: float) -> None:
            if self._closed or self._wanted != percent:
                raise MergingStopped
            status = f"merging, {100 * share:.0f} %"
            if status != self.status:
                self.status = status
                self._report(False)

        report(0.0)
        return ReducedScene(self._merger.merged(self._count(percent), report).scene, "merged")

    def _keep(self, percent: int, merged: ReducedScene) -> None:
        """Keep a merged scene, and older ones as long as all together have no more Gaussians than the scene itself."""
        self._merged.pop(percent, None)
        while self._merged and sum(len(s.scene) for s in self._merged.values()) + len(merged.scene) > len(self.scene):
            del self._merged[next(iter(self._merged))]
        self._merged[percent] = merged
