"""Makes the scene of a cell, and tells its tools or the reason why it cannot be made."""

from __future__ import annotations

import functools
import tempfile
import time
from pathlib import Path

from torch import Tensor

from pointsplat_ns.compression.fine_tune import fine_tune
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import write_ply
from pointsplat_ns.pruning import method_named, resolve_keep, score_of, select
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tables.refiners import Refiners, Weights
from pointsplat_ns.tables.scene import OpenedScene, TableOptions
from pointsplat_ns.tables.splat_transform import SplatTransform
from pointsplat_ns.tables.ways import PROTOCOL, Network, Way
from pointsplat_ns.tradeoff.measuring import MadeScene, make
from pointsplat_ns.tradeoff.settings import DENSE, EFFORTS, Setting


class Tools:
    """The tools of cells besides the package: weights, and splat-transform, which npx searches by default, when first
    needed."""

    def __init__(self, options: TableOptions, refiners: Refiners, program: str | None = None):
        self.options, self.refiners, self.program = options, refiners, program

    @functools.cached_property
    def peer(self) -> SplatTransform:
        """splat-transform."""
        return SplatTransform(self.program)

    def missing(self, way: Way, share: float, scene: str) -> str:
        """The reason why a cell, of a way, a share and a scene's name, cannot be measured; empty if it can."""
        if way.mode is not None:
            if self.peer.missing:
                return f"splat-transform cannot be run ({self.peer.missing})"
            if way.mode >= len(self.peer.modes):
                return f"splat-transform {self.peer.version} has no such mode"
        return "" if way.network is None else self.refiners.find(way.network, share, scene)[1]

    def made_with(self, way: Way, share: float, scene: str) -> str:
        """Text on the tools of a measurable cell. A measured cell with the same text need not be measured again."""
        if way.mode is not None:
            return self.peer.modes[way.mode].label
        if way.network is not None:
            return self.weights(way.network, share, scene).text
        return f"{self.options.fine_tune} steps" if way.fine_tuned else ""

    def weights(self, network: Network, share: float, scene: str) -> Weights:
        """The weights of a measurable cell."""
        weights, _ = self.refiners.find(network, share, scene)
        assert weights is not None
        return weights

    def words(self, way: Way, share: float, scene: str) -> list[str]:
        """The options of the command that measures a cell with the same tools."""
        words = self.options.words
        if way.network is not None:
            words += ["--refiners", str(self.weights(way.network, share, scene).path)]
        if way.mode is not None and self.program:
            words += ["--splat-transform", self.program]
        return words


class Maker:
    """Makes the scenes of one scene's cells. Scores are computed once for all budgets, which changes no result."""

    def __init__(self, scene: OpenedScene, name: str, tools: Tools):
        self.scene, self.name, self.tools = scene, name, tools
        self._scores: dict[tuple[str, float | None], tuple[Tensor, float]] = {}
        self._folder: tempfile.TemporaryDirectory[str] | None = None

    def close(self) -> None:
        """Remove files for other programs."""
        if self._folder is not None:
            self._folder.cleanup()

    def make(self, way: Way, share: float, progress: Progress) -> MadeScene:
        """The scene of a measurable cell, and the cost of making it. The time includes scores that other cells share.
        Raises ProgramFailed if another program fails, SceneError if its result cannot be read or the SH degree exceeds
        the refiner's, and DataError if there are no views."""
        dense = self.scene.dense
        if way.name == DENSE:
            return MadeScene(dense, 0.0, None)
        count = resolve_keep(len(dense), share, dense.sh_degree)
        if way.mode is not None:
            scene, usage = self.tools.peer.modes[way.mode].reduce(self._ply(), count, timeout=7200.0)
            return MadeScene(scene.to(dense.device), usage.seconds, usage.peak_bytes)
        if method_named(way.by).score is None:
            return make(dense, Setting(count, dense.sh_degree, way.repair, way.by), self.scene.new_views, progress)
        assert way.repair not in EFFORTS, "repairs are of merged scenes"
        scores, before = self._scored(way, functools.partial(progress, "scoring"))
        start = time.perf_counter()
        scene = dense[select(scores, count)]
        if way.network is not None:
            scene = self.tools.weights(way.network, share, self.name).refiner(scene)
        if way.fine_tuned:
            scene = self._tuned(scene, functools.partial(progress, "fine-tuning"))
        return MadeScene(scene, before + time.perf_counter() - start, None)

    def _scored(self, way: Way, progress: functools.partial[None]) -> tuple[Tensor, float]:
        """Scores (N,), and the seconds of computing them."""
        key = way.by, way.opacity_weight
        if key not in self._scores:
            method, start = method_named(way.by), time.perf_counter()
            views = None
            if method.needs_views:
                views = self.scene.training.views.spread(self.tools.options.scoring_views)
            scores = score_of(self.scene.dense, method, views, way.opacity_weight, progress)
            self._scores[key] = scores, time.perf_counter() - start
        return self._scores[key]

    def _tuned(self, scene: Gaussians, progress: functools.partial[None]) -> Gaussians:
        """The scene optimised against training photos, or the dense scene's renders where there are no photos."""
        training = self.scene.training
        targets = self.scene.dense if training.photos is None else training.photos
        return fine_tune(
            scene, training.views, targets, self.tools.options.fine_tune, seed=PROTOCOL.seed, progress=progress
        )

    def _ply(self) -> Path:
        """The dense scene as a PLY for other programs."""
        if self._folder is None:
            self._folder = tempfile.TemporaryDirectory()
            write_ply(self.scene.dense, Path(self._folder.name) / "dense.ply")
        return Path(self._folder.name) / "dense.ply"
