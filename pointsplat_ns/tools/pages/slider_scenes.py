"""Scenes at the shares of a slider: first selected by a score, then merged."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.pruning import need_usable, resolve_keep, select
from pointsplat_ns.pruning.baselines import coverage_score
from pointsplat_ns.pruning.merging import Merger
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.usable import keep_usable
from pointsplat_ns.system.files import one_line
from pointsplat_ns.tools.watched_file import WatchedFile


@dataclass(eq=False)
class Level:
    """A scene with a share of its Gaussians."""

    scene: Gaussians
    how: str  # text on its method, which follows the count
    spz: bytes = b""  # the encoded scene, after the first request


class MergingStopped(Exception):
    """Raised while merging when a page has chosen another share."""


class ViewedScene:
    """A scene for the viewer, with any share of its Gaussians. Several pages may use it, from
    threads of their own. Merged scenes equal the results of ``pointsplat prune``.

    Undrawable Gaussians are dropped. Raises SceneError if none remains.

    Args:
        name: name to show.
        path: path of the scene; None if it has none.
        file: the file of the scene, to notice its changes; None if it has none.
        scene: N Gaussians.
        source: source of views for merging.
        there: existing smaller scenes, such as levels of a stream; each serves shares near its
            count.
    """

    def __init__(
        self,
        name: str,
        path: Path | None,
        scene: Gaussians,
        source: ViewProvider,
        there: Sequence[Gaussians] = (),
        file: WatchedFile | None = None,
    ):
        need_usable(scene)
        self.name = name
        self.path = path
        self.file = file
        self.source = source
        self.scene = keep_usable(scene, name)
        """All drawable Gaussians."""
        self.whole = Level(self.scene, "all")
        """The level of 100 %."""
        self._there = [
            Level(level, f"level {n} of the stream") for n, level in enumerate(there, start=1)
        ]
        self._chosen: tuple[int, Level] = (100, self.whole)
        """The latest share selected by coverage, with its level."""
        self._merged: dict[int, Level] = {}
        self._choices = 0
        """Number of choices of a share so far. A new choice stops merging for older ones."""
        self._merging = threading.Lock()

    def at(self, percent: int) -> Level:
        """The best available level of 1 to 100 percent of the Gaussians, without merging."""
        found = self.ready(percent)
        if found is None and self._chosen[0] != percent:
            self._chosen = (percent, Level(self._by_coverage(percent), "chosen by coverage"))
        return found or self._chosen[1]

    def stop(self) -> None:
        """Stop merging: a page has chosen another share, or was closed."""
        self._choices += 1

    def merged(self, percent: int) -> Level | None:
        """The final level of a share, merged if necessary; None if merging was stopped."""
        with self._merging:
            if (found := self.ready(percent)) is not None:
                return found
            begun = self._choices

            def report(share: float) -> None:
                if self._choices != begun:
                    raise MergingStopped

            try:
                count = resolve_keep(len(self.scene), percent / 100)
                level = Level(self._merger.merged(count, report).scene, "merged")
            except MergingStopped:
                return None
            except (PointSplatError, MemoryError, RuntimeError) as error:
                how = f"chosen by coverage, because merging failed: {one_line(error)}"
                level = Level(self._by_coverage(percent), how)
            # Older levels stay in memory while all together have at most as many Gaussians as the
            # scene.
            cached = sum(len(older.scene) for older in self._merged.values())
            while self._merged and cached + len(level.scene) > len(self.scene):
                cached -= len(self._merged.pop(next(iter(self._merged))).scene)
            self._merged[percent] = level
            return level

    def ready(self, percent: int) -> Level | None:
        """The final level of a share, if it is available: a level of a stream, merged, or all
        Gaussians."""
        if percent == 100:
            return self.whole
        count = len(self.scene) * percent / 100
        near = [level for level in self._there if abs(len(level.scene) - count) <= 0.1 * count]
        return min(
            near, key=lambda level: abs(len(level.scene) - count), default=self._merged.get(percent)
        )

    def close(self, timeout: float) -> None:
        """Stop merging, wait for at most ``timeout`` seconds, and prevent further merging."""
        self.stop()
        self._merging.acquire(timeout=timeout)

    def _by_coverage(self, percent: int) -> Gaussians:
        return self.scene[select(self._scores, resolve_keep(len(self.scene), percent / 100))]

    @cached_property
    def _scores(self) -> Tensor:
        return coverage_score(self.scene)

    @cached_property
    def _merger(self) -> Merger:
        return Merger(self.scene, self.source.for_merging())
