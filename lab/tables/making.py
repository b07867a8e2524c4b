"""Makes the scene of a cell: by this package, by weights that are found by their metadata, or by
splat-transform, the peer of merging. Tells its tools, or the reason why it cannot be made."""

from __future__ import annotations

import functools
import itertools
import math
import random
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import pointsplat_ns as ps
from lab.common.ways import SplatTransform
from lab.tables.scenes import OpenedScene, Options
from lab.tables.ways import PROTOCOL, WAYS, Network, Way
from pointsplat_ns.pipeline.optimiser import RATES, Adam, AdamSettings, optimised
from pointsplat_ns.pipeline.photos.examples import Example
from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner, load_refiner
from pointsplat_ns.pruning import method_named, resolve_keep, score_of, select
from pointsplat_ns.pruning.paper import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.refinement import read_metadata
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.reading import source_file
from pointsplat_ns.scene.runs import RUN_FILES


class Tools:
    """The tools of cells besides the package: weights, and splat-transform, by default that on
    PATH, when first needed."""

    def __init__(self, options: Options, refiners: Refiners, program: str | None = None):
        self.options = options
        self.refiners = refiners
        self.program = program

    @functools.cached_property
    def peer(self) -> SplatTransform:
        """splat-transform."""
        return SplatTransform(self.program)

    def missing(self, way: Way, share: float, scene: str) -> str:
        """The reason why a cell, of a way, a share and a scene's name, cannot be measured; empty if
        it can."""
        if way.mode is not None:
            if self.peer.missing:
                return f"splat-transform cannot be run ({self.peer.missing})"
            if way.mode >= len(self.peer.modes):
                return f"splat-transform {self.peer.version} has no such mode"
        return "" if way.network is None else self.refiners.find(way.network, share, scene)[1]

    def made_with(self, way: Way, share: float, scene: str) -> str:
        """Text on the tools of a measurable cell. A measured cell with the same text need not be
        measured again."""
        if way.mode is not None:
            return self.peer.modes[way.mode].label
        if way.network is not None:
            return made_with(self.refiners.find(way.network, share, scene)[0])
        return f"{self.options.fine_tune} steps" if way.fine_tuned else ""

    def words(self, way: Way, share: float, scene: str) -> list[str]:
        """The options of the command that measures a cell with the same tools."""
        words = self.options.words
        if way.network is not None:
            words += [
                "--refiners",
                *(str(each.path) for each in self.refiners.find(way.network, share, scene)[0]),
            ]
        if way.mode is not None and self.program:
            words += ["--splat-transform", self.program]
        return words


class Maker:
    """Makes the scenes of one scene's cells. Scores are computed once for all budgets, which
    changes no result."""

    def __init__(self, scene: OpenedScene, name: str, tools: Tools):
        self.scene = scene
        self.name = name
        self.tools = tools
        self._scores: dict[tuple[str, float | None], tuple[Tensor, float]] = {}

    def make(self, way: Way, share: float) -> tuple[list[Gaussians], float]:
        """The scene of a measurable cell, one of each network where several fit, and the seconds of
        making one, with those of scores that other cells share. Raises ProgramFailed if another
        program fails, SceneError if its result cannot be read or the SH degree exceeds the
        refiner's, and DataError if there are no views."""
        dense = self.scene.dense
        start = time.perf_counter()
        if way == WAYS.dense:
            return [dense], 0.0
        count = resolve_keep(len(dense), share, dense.sh_degree)
        path = self.scene.path
        data = self.scene.data
        if way.mode is not None:
            with tempfile.TemporaryDirectory() as folder:
                write_ply(dense, Path(folder) / "dense.ply")
                scene, usage = self.tools.peer.modes[way.mode].reduce(
                    Path(folder) / "dense.ply", count, timeout=7200.0
                )
            return [scene.to(dense.device)], usage.seconds
        if way.repaired:
            return [ps.compact(path, count, data=data).scene], time.perf_counter() - start
        if method_named(way.by).score is None:
            return [ps.prune(path, count, way.by, data=data)], time.perf_counter() - start
        scores, before = self._scored(way)
        start = time.perf_counter()
        scene = dense[select(scores, count)]
        made = [scene]
        if way.network is not None:
            made = [
                each.refiner(scene)
                for each in self.tools.refiners.find(way.network, share, self.name)[0]
            ]
        if way.fine_tuned:
            made = [fine_tuned(scene, dense, self.scene, self.tools.options.fine_tune)]
        return made, before + (time.perf_counter() - start) / len(made)

    def _scored(self, way: Way) -> tuple[Tensor, float]:
        """Scores (N,), and the seconds of computing them."""
        key = way.by, way.opacity_weight
        if key not in self._scores:
            method = method_named(way.by)
            start = time.perf_counter()
            views = (
                self.scene.training.views.spread(self.tools.options.scoring_views)
                if method.needs_views
                else None
            )
            scores = score_of(self.scene.dense, method, views, way.opacity_weight)
            self._scores[key] = scores, time.perf_counter() - start
        return self._scores[key]


def fine_tuned(small: Gaussians, dense: Gaussians, scene: OpenedScene, steps: int) -> Gaussians:
    """The recovery step of the baselines: steps of Adam on 0.8 L1 + 0.2 (1 - SSIM) against training
    photos, or renders of the dense scene where there are no photos. Each view comes once before any
    is repeated."""

    def examples() -> Iterator[Callable[[], Example]]:
        (views, photos) = (scene.training.views, scene.training.photos)
        order = random.Random(PROTOCOL.seed)
        with torch.no_grad():
            targets = photos or [render(dense, view) for view in views]
        while True:
            for index in reversed(order.sample(range(len(views)), len(views))):
                yield functools.partial(Example, views[index], targets[index].to(small.means))

    scenes = optimised(
        small, Adam(small, AdamSettings(), RATES), examples(), pixel_loss="l1", together=1
    )
    return next(itertools.islice(scenes, steps - 1, None))


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained refiner."""

    path: Path
    """Path as given."""
    refiner: TrainedRefiner
    trained_on: frozenset[str]
    """Names of training scenes; empty if they are not known."""
    keeps: tuple[float, ...]
    """Budgets of the training: shares, or counts above 1."""
    training: dict[str, Any]
    """How the network was trained, as far as its file says: steps, loss, rates, supervision."""

    @cached_property
    def digest(self) -> str:
        """The first 12 hexadecimal digits of the file's SHA-256."""
        return source_file(self.refiner.source).sha256[:12]

    @property
    def network(self) -> Network:
        """Description of the network and its training."""
        config = self.refiner.network.config
        settings = self.refiner.settings
        weight = settings.opacity_weight
        if weight is None and method_named(settings.by).weighs_opacity:
            weight = DEFAULT_OPACITY_WEIGHT
        return Network(
            config.encoder, settings.by, weight, config.use_appearance, config.use_position
        )

    @property
    def kind(self) -> tuple:
        """What trainings that differ by their seed alone have in common."""
        known = {
            name: value for name, value in self.training.items() if name != "steps"
        }  # a time has its own steps
        return self.refiner.network.config, self.network, self.keeps, self.trained_on, known


def made_with(all_weights: Sequence[Weights]) -> str:
    """One line that identifies weights of one kind."""
    first = all_weights[0]
    digests = ", ".join(weights.digest for weights in all_weights)
    parameters = sum(parameter.numel() for parameter in first.refiner.network.parameters())
    keeps = ", ".join(f"{keep:g}" for keep in first.keeps)
    words = [f"{parameters:,} parameters", f"norm by {first.refiner.network.config.norm}"]
    words += [f"{first.network}, keep {keeps}"]
    said = {
        name: dict.fromkeys(weights.training[name] for weights in all_weights)
        for name in first.training
    }
    known = (
        f"{name.replace('_', ' ')} {' / '.join(map(str, values))}" for name, values in said.items()
    )
    words += [", ".join(known)] if said else []
    words += [f"{len(first.trained_on)} scenes"] if first.trained_on else []
    return f"weights {digests} ({'; '.join(words)})"


class Refiners:
    """Weights to choose from; paths and errors are those of :func:`pointsplat_ns.load_refiner`."""

    def __init__(self, paths: Sequence[Path]):
        self.all = tuple(_read(path) for given in paths for path in _trained(given))

    def find(self, network: Network, share: float, scene: str) -> tuple[list[Weights], str]:
        """The weights for a row (the needed network, a share of the Gaussians, the name of a
        scene), or the reason for none. They were trained for this network and this share, and not
        on the scene itself. Of several kinds the first is taken; those of a kind differ by their
        seed."""
        fitting = [
            weights
            for weights in self.all
            if weights.network == network
            and any(math.isclose(keep, share, rel_tol=1e-3) for keep in weights.keeps)
        ]
        if unseen := [weights for weights in fitting if scene not in weights.trained_on]:
            return [weights for weights in unseen if weights.kind == unseen[0].kind], ""
        if fitting:
            return [], f"its weights ({fitting[0].path}) were trained on this scene"
        missing = f"no weights were given (--refiners) of a {network}, to {100 * share:g} %"
        return [], f"{missing}; to train them: {network.command(share)}"


def _trained(path: Path) -> list[Path]:
    """Finished trainings below a folder that is no run itself; or the path."""
    if path.is_dir() and not (path / RUN_FILES.config).is_file():
        return sorted(file.parent for file in path.glob(f"*/*/*/{RUN_FILES.refiner}")) or [path]
    return [path]


def _read(path: Path) -> Weights:
    inside = (
        path / RUN_FILES.refiner
    )  # of a finished training; a checkpoint does not name its training scenes
    file = inside if path.is_dir() and inside.is_file() else path
    metadata = read_metadata(file) if file.suffix.lower() == ".safetensors" else {}
    refiner = load_refiner(file)
    more = metadata.get("more_keeps")
    more = (
        [keep for keep in more if isinstance(keep, (int, float))] if isinstance(more, list) else []
    )
    known = {
        name: metadata[name]
        for name in TRAINING_SETTINGS
        if isinstance(metadata.get(name), (str, int, float))
    }
    return Weights(
        path, refiner, _names(metadata.get("scenes")), (refiner.settings.keep, *more), known
    )


TRAINING_SETTINGS = (
    "size",
    "steps",
    "supervision",
    "pixel_loss",
    "lpips_weight",
    "lpips_net",
    "rates",
    "rate_factor",
    "schedule",
)
"""Entries of a refiner's metadata that a row of a table names."""


def _names(scenes: Any) -> frozenset[str]:
    """Names of scenes from metadata: a list, or text with commas."""
    words = (
        scenes.split(",") if isinstance(scenes, str) else scenes if isinstance(scenes, list) else []
    )
    return frozenset(str(word).strip() for word in words if str(word).strip())
