"""A scene at the shares of a slider: chosen by a score at once, and merged in the background."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import one_line
from pointsplat_ns.io.usable import keep_usable
from pointsplat_ns.looking.content import thinned
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.merging import Merger
from pointsplat_ns.pruning import resolve_keep, select
from pointsplat_ns.pruning.coverage import coverage_score


@dataclass(eq=False)
class Level:
    """A scene at a share of its Gaussians."""

    scene: Gaussians
    how: str
    """Text on the way it was made, which follows the count."""
    spz: bytes = b""
    """The scene for pages, once one has asked for it."""

    @cached_property
    def light(self) -> Gaussians:
        """About 100,000 of the Gaussians, enlarged to cover the same area, for moving cameras."""
        return thinned(self.scene, 100_000)


class MergingStopped(Exception):
    """Raised in merging for a share that no page wants any more."""


class Levels:
    """A scene at any share of its Gaussians, for several pages. What is chosen by coverage is there at once; a thread
    merges to the count of ``pointsplat prune``, which gives its scene.

    Undrawable Gaussians are left out. ``there`` are smaller scenes that exist already, such as levels of a stream; each
    stands for shares near its count. Merging uses the dataset's views of ``source``.
    """

    def __init__(self, scene: Gaussians, source: ViewSource, there: Sequence[Gaussians] = ()):
        self.scene = keep_usable(scene, "the scene")
        """All drawable Gaussians."""
        self.whole = Level(self.scene, "all")
        """The level of 100 %."""
        self.status = ""
        """Text on the merging; empty if there is none."""
        self._there = [Level(level, f"level {n} of the stream") for n, level in enumerate(there, start=1)]
        self._chosen: tuple[int, Level] = (100, self.whole)
        """The newest share that was chosen by coverage."""
        self._merged: dict[int, Level] = {}
        self._source = source
        self._wanted: int | None = None
        """The share that is merged, in percent."""
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="merging", daemon=True)
        self._thread.start()

    def at(self, percent: int) -> Level:
        """The best level of 1 to 100 percent of the Gaussians without more merging."""
        with self._changed:
            found = self.ready(percent)
            if found is None and self._chosen[0] != percent:
                part = self.scene[select(self._scores, self._count(percent))]
                self._chosen = (percent, Level(part, "chosen by coverage"))
            return found or self._chosen[1]

    def stop(self, percent: int) -> None:
        """Stop merging to any other share: a page has chosen this one."""
        with self._changed:
            self._wanted = percent if self._wanted == percent else None

    def merged(self, percent: int, seconds: float) -> Level | None:
        """The level of a share that needs no more merging. If there is none, merge, unless another share is being
        merged, and wait for news at most some seconds."""
        with self._changed:
            if self.ready(percent) is None:
                self._wanted = self._wanted or percent
                self._changed.notify_all()
                before = self.status
                self._changed.wait_for(
                    lambda: self._closed or self.ready(percent) is not None or self.status != before, seconds
                )
            return self.ready(percent)

    def ready(self, percent: int) -> Level | None:
        """The level of a share that needs no merging any more: of a stream, merged, or all; None if there is none."""
        if percent == 100:
            return self.whole
        count = len(self.scene) * percent / 100
        near = [level for level in self._there if abs(len(level.scene) - count) <= 0.1 * count]
        return min(near, key=lambda level: abs(len(level.scene) - count), default=self._merged.get(percent))

    def close(self, timeout: float) -> None:
        """Stop merging, and wait for it at most ``timeout`` seconds."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _count(self, percent: int) -> int:
        return resolve_keep(len(self.scene), percent / 100)

    @cached_property
    def _scores(self) -> Tensor:
        return coverage_score(self.scene)

    @cached_property
    def _merger(self) -> Merger:
        return Merger(self.scene, self._source.for_merging())

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closed or self._wanted is not None)
                percent = self._wanted
            if self._closed or percent is None:
                return

            def report(share: float, percent: int = percent) -> None:
                if self._closed or self._wanted != percent:
                    raise MergingStopped
                self._say(f"merging, {100 * share:.0f} %")

            try:
                report(0.0)
                level = Level(self._merger.merged(self._count(percent), report).scene, "merged")
            except MergingStopped:
                self._say("")
                continue
            except (PointSplatError, MemoryError, RuntimeError) as error:
                chosen = self.scene[select(self._scores, self._count(percent))]
                level = Level(chosen, f"chosen by coverage, because merging failed: {one_line(error)}")
            with self._changed:
                self._keep(percent, level)
                self._wanted = None if self._wanted == percent else self._wanted
            self._say("")

    def _say(self, status: str) -> None:
        with self._changed:
            self.status = status
            self._changed.notify_all()

    def _keep(self, percent: int, level: Level) -> None:
        """Keep a merged level, and older ones as long as all together have no more Gaussians than the scene itself."""
        while self._merged and sum(len(s.scene) for s in self._merged.values()) + len(level.scene) > len(self.scene):
            del self._merged[next(iter(self._merged))]
        self._merged[percent] = level
