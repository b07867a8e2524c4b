"""Makes the scene of a cell: by this package, by weights that are found by their metadata, or by
splat-transform, the peer of merging. Tells its tools, or the reason why it cannot be made."""

from __future__ import annotations

import functools
import math
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

import pointsplat_ns as ps
from lab.common.ways import SplatTransform
from lab.tables.fine_tune import FINE_TUNING, REDUCED, Curve, fine_tuned
from lab.tables.scenes import OpenedScene, Options
from lab.tables.ways import WAYS, Network, Way
from pointsplat_ns.pipeline.trained_refiner import TrainedRefiner, load_refiner
from pointsplat_ns.pruning import method_named, resolve_keep, score_of, select
from pointsplat_ns.pruning.paper import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.refinement import read_metadata
from pointsplat_ns.refinement.weights import shipped_refiner
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.reading import source_file
from pointsplat_ns.scene.runs import RUN_FILES, is_refiner_method


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
        return self.refiners.find(way, share, scene)[1]

    def made_with(self, way: Way, share: float, scene: str) -> str:
        """Text on the tools of a measurable cell. A measured cell with the same text need not be
        measured again."""
        if way.mode is not None:
            return self.peer.modes[way.mode].label
        if way.network is not None:
            return made_with(self.refiners.find(way, share, scene)[0])
        return FINE_TUNING[way.by].words(share, self.options.fine_tune) if way.fine_tuned else ""

    def words(self, way: Way, share: float, scene: str) -> list[str]:
        """The options of the command that measures a cell with the same tools."""
        words = self.options.words
        if way.network is not None:
            found = self.refiners.find(way, share, scene)[0]
            words += ["--refiners", *(str(each.path) for each in found)]
        if way.mode is not None and self.program:
            words += ["--splat-transform", self.program]
        return words


@dataclass(frozen=True)
class Made:
    """The scene of a cell, one of each network where several fit."""

    scenes: list[Gaussians]
    seconds: float
    """CPU seconds of making one, with those of scores that other cells share; of another program,
    seconds on the clock."""
    curve: Curve = field(default_factory=list)
    """PSNR over the steps of fine-tuning; empty without."""


class Maker:
    """Makes the scenes of one scene's cells. Scores are computed once for all budgets, which
    changes no result."""

    def __init__(self, scene: OpenedScene, name: str, tools: Tools):
        self.scene = scene
        self.name = name
        self.tools = tools
        self._scores: dict[tuple[str, float | None], tuple[Tensor, float]] = {}

    def make(self, way: Way, share: float) -> Made:
        """The scene of a measurable cell. Raises ProgramFailed if another program fails, SceneError
        if its result cannot be read or the SH degree exceeds the refiner's, and DataError if there
        are no views."""
        dense = self.scene.dense
        start = time.process_time()
        if way == WAYS.dense:
            return Made([dense], 0.0)
        count = resolve_keep(len(dense), share, dense.sh_degree)
        path = self.scene.path
        data = self.scene.data
        if way.mode is not None:
            with tempfile.TemporaryDirectory() as folder:
                write_ply(dense, Path(folder) / "dense.ply")
                scene, usage = self.tools.peer.modes[way.mode].reduce(
                    Path(folder) / "dense.ply", count, timeout=7200.0
                )
            return Made([scene.to(dense.device)], usage.seconds)
        if way.repaired:
            return Made([ps.compact(path, count, data=data).scene], time.process_time() - start)
        if method_named(way.by).score is None:
            return Made([ps.prune(path, count, way.by, data=data)], time.process_time() - start)
        if way.fine_tuned:
            return self._fine_tuned(way, share)
        scores, before = self._scored(way)
        start = time.process_time()
        scene = dense[select(scores, count)]
        made = [scene]
        if way.network is not None:
            made = [
                each.refiner(scene, share)
                for each in self.tools.refiners.find(way, share, self.name)[0]
            ]
        return Made(made, before + (time.process_time() - start) / len(made))

    def _fine_tuned(self, way: Way, share: float) -> Made:
        """The scene after all rounds of pruning and fine-tuning. Scores of the first round are
        those of the dense scene."""
        settings = FINE_TUNING[way.by]
        steps = self.tools.options.fine_tune
        dense = self.scene.dense
        last = dense
        curve: Curve = []
        seconds = 0.0
        for number, kept in enumerate(settings.shares(share)):
            scores, spent = self._scored(way) if number == 0 else self._score(way, last)
            last = last[select(scores, resolve_keep(len(dense), kept, dense.sh_degree))]
            last, points, more = fine_tuned(last, self.scene, settings, steps)
            curve += [(number * steps + step, psnr) for step, psnr in points]
            seconds += spent + more
        return Made([last], seconds, curve)

    def _scored(self, way: Way) -> tuple[Tensor, float]:
        """Scores (N,) of the dense scene, and the seconds of computing them."""
        key = way.by, way.opacity_weight
        if key not in self._scores:
            self._scores[key] = self._score(way, self.scene.dense)
        return self._scores[key]

    def _score(self, way: Way, scene: Gaussians) -> tuple[Tensor, float]:
        """Scores (K,) of a scene, and the seconds of computing them."""
        method = method_named(way.by)
        start = time.process_time()
        views = self.scene.training.views
        if self.tools.options.scoring_views is not None:
            views = views.spread(self.tools.options.scoring_views)
        views = views.resized(max(1, max(views.width, views.height) // REDUCED.get(way.by, 1)))
        scores = score_of(scene, method, views if method.needs_views else None, way.opacity_weight)
        return scores, time.process_time() - start


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


SHIPPED = Path("shipped")
"""The name of the weights that ship for selections, which commands keep in place of their path."""


class Refiners:
    """Weights to choose from: those that ship for selections (``shipped``), files, runs, and the
    newest run of each name at any depth below a folder. Errors are those of
    :func:`pointsplat_ns.load_refiner`."""

    def __init__(self, paths: Sequence[Path]):
        self.all = tuple(_read(path) for given in paths for path in _trained(given))

    def find(self, way: Way, share: float, scene: str) -> tuple[list[Weights], str]:
        """The weights for a row (a way, a share of the Gaussians, the name of a scene), or the
        reason for none, which is empty for ways without a network. They were trained for this
        network and this share; not on the scene itself, or for rows of own photos on its training
        photos. Of several kinds the first is taken; those of a kind differ by their seed."""
        network = way.network
        if network is None:
            return [], ""
        fitting = [
            weights
            for weights in self.all
            if weights.network == network
            and any(math.isclose(keep, share, rel_tol=1e-3) for keep in weights.keeps)
        ]
        reasons = {weights.path: _unfit(weights, way.own, scene) for weights in fitting}
        if fit := [weights for weights in fitting if not reasons[weights.path]]:
            return [weights for weights in fit if weights.kind == fit[0].kind], ""
        if fitting:
            path, why = next(iter(reasons.items()))
            return [], f"its weights ({path}) {why}"
        of = "these scenes' photos" if way.own else "other scenes"
        missing = (
            f"no weights were given (--refiners) of a {network}, to {100 * share:g} %, on {of}"
        )
        return [], f"{missing}; to train them: {network.command(share, way.own)}"


def _unfit(weights: Weights, own: bool, scene: str) -> str:
    """The reason why weights that fit a row otherwise do not fit its protocol; empty if they do."""
    if not weights.trained_on:
        return "do not say which scenes they were trained on"
    if not own:
        return "were trained on this scene" if scene in weights.trained_on else ""
    if scene not in weights.trained_on:
        return "were not trained on this scene"
    seen = weights.training.get("supervision")
    return "" if seen == "photos" else f"were trained on {seen or 'unknown'} targets, not on photos"


def _trained(path: Path) -> list[Path]:
    """The newest finished training of each name below a folder that is no run itself; or the
    path."""
    is_run = any((path / name).is_file() for name in (RUN_FILES.config, RUN_FILES.refiner))
    if not path.is_dir() or is_run:
        return [path]
    newest: dict[Path, Path] = {}
    for place, inner, files in os.walk(path):
        inner[:] = sorted(name for name in inner if not name.startswith("."))
        if RUN_FILES.refiner not in files:
            continue
        inner.clear()  # no search inside of a run
        run = Path(place)
        # EXPERIMENT/METHOD/TIME, or a folder that was moved out of that layout
        name = run.parents[1] if is_refiner_method(run.parent.name) else run
        known = newest.get(name)
        if known is None or _when(run) > _when(known):
            newest[name] = run
    return sorted(newest.values()) or [path]


def _when(run: Path) -> tuple[float, str]:
    """Sort key of a training's age: when its weights were written."""
    return (run / RUN_FILES.refiner).stat().st_mtime, run.name


def _read(path: Path) -> Weights:
    inside = (
        path / RUN_FILES.refiner
    )  # of a finished training; a checkpoint does not name its training scenes
    file = inside if path.is_dir() and inside.is_file() else path
    file = shipped_refiner("paper") if path == SHIPPED else file
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
