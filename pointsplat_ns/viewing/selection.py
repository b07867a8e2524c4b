"""A scene at a budget that somebody changes by a slider: at once by a score, and merged as soon as there is time."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import keep_usable
from pointsplat_ns.looking.content import thinned
from pointsplat_ns.looking.view_source import MERGED_FROM, ViewSource
from pointsplat_ns.pruning import resolve_keep, select
from pointsplat_ns.pruning.coverage import coverage_score
from pointsplat_ns.pruning.methods import prune

REST_SECONDS = 1.0
"""How long the budget has to stay before it is merged."""

_SMALLEST_PART = 20_000
"""Parts for moving cameras are no smaller."""


@dataclass(eq=False)
class ShownScene:
    """A scene as it is shown, and how it was made."""

    scene: Gaussians
    how: str
    """Text that follows the count."""
    _parts: dict[int, Gaussians] = field(default_factory=dict)

    def part(self, share: float) -> Gaussians:
        """The scene with about this share of its Gaussians, grown so that they cover as much: for moving cameras."""
        count = max(round(len(self.scene) * share), _SMALLEST_PART)
        if count >= len(self.scene):
            return self.scene
        count = 2 ** (count.bit_length() - 1)  # one of few, so that most are at hand
        if count not in self._parts:
            self._parts[count] = thinned(self.scene, count)
        return self._parts[count]


class Stopped(Exception):
    """Raised within merging that nobody waits for any more."""


class Selection:
    """A scene and how much of it is shown. :meth:`choose` acts at once; a thread then merges to the same budget, which
    gives the scene that ``pointsplat prune`` writes.

    Args:
        scene: N Gaussians. Those that cannot be drawn are left out.
        source: where its views come from: merging looks from those of its dataset.
        changed: called, from any thread, with True when another scene is shown, with False when there is only news.
        rest: seconds that a budget has to stay before it is merged.
    """

    def __init__(
        self, scene: Gaussians, source: ViewSource, changed: Callable[[bool], None], rest: float = REST_SECONDS
    ):
        self.scene = keep_usable(scene, "the scene")
        """All Gaussians that can be drawn."""
        self.shown = ShownScene(self.scene, "all")
        """What is shown now."""
        self.news = ""
        """What the thread is doing; empty for nothing."""
        self.whole = self.shown
        """All of it."""
        self._merged: dict[int, ShownScene] = {}
        self._source, self._report, self._rest = source, changed, rest
        self._wanted = 100
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._work, name="merging", daemon=True)
        self._thread.start()

    @property
    def percent(self) -> int:
        """The budget."""
        return self._wanted

    def choose(self, percent: int) -> None:
        """Show so many percent of the Gaussians, 1 to 100."""
        with self._changed:
            self._wanted = percent = min(max(round(percent), 1), 100)
            self.shown, self.news = self._at(percent), ""
            self._changed.notify_all()
        self._report(True)

    def close(self, timeout: float = 5.0) -> None:
        """Stop merging, and wait until that has stopped, for so many seconds."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join(timeout)

    def _count(self, percent: int) -> int:
        return resolve_keep(len(self.scene), percent / 100)

    def _at(self, percent: int) -> ShownScene:
        """The scene at a budget, of what is at hand."""
        if percent == 100:
            return self.whole
        if percent in self._merged:
            return self._merged[percent]
        return ShownScene(self.scene[select(self._scores, self._count(percent))], "chosen by coverage")

    @cached_property
    def _scores(self) -> Tensor:
        return coverage_score(self.scene)

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._closed and (self._wanted == 100 or self._wanted in self._merged):
                    self._changed.wait()
                wanted = self._wanted
                self._changed.wait(self._rest)
                if self._closed:
                    return
                if wanted != self._wanted:
                    continue  # or woken for nothing: then it rested less, which is no harm
            try:
                merged = self._merge(wanted)
            except Stopped:
                continue
            except (PointSplatError, MemoryError, RuntimeError) as error:
                merged = ShownScene(self._at(wanted).scene, f"chosen by coverage, as merging failed: {error}")
            with self._changed:
                self._keep(wanted, merged)
                if wanted == self._wanted:
                    self.shown, self.news = merged, ""
            self._report(True)

    def _merge(self, percent: int) -> ShownScene:
        def report(share: float) -> None:
            if self._closed or self._wanted != percent:
                raise Stopped
            news = f"merging, {100 * share:.0f} %"
            if news != self.news:
                self.news = news
                self._report(False)

        report(0.0)
        views = self._source.known(MERGED_FROM)
        return ShownScene(prune(self.scene, self._count(percent), views=views, progress=report), "merged")

    def _keep(self, percent: int, merged: ShownScene) -> None:
        """Keep what was merged, and of the others as many as take no more memory than the scene itself."""
        self._merged.pop(percent, None)
        while self._merged and sum(len(s.scene) for s in self._merged.values()) + len(merged.scene) > len(self.scene):
            del self._merged[next(iter(self._merged))]
        self._merged[percent] = merged
