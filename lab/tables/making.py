"""Makes the scene of a cell: by this package, by weights that are found by their metadata, or by splat-transform, a
Node package and the peer of merging. Tells its tools, or the reason why it cannot be made."""

from __future__ import annotations

import functools
import math
import re
import shlex
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from torch import Tensor

from lab.tables.fine_tune import fine_tune
from lab.tables.scene import OpenedScene, TableOptions
from lab.tables.ways import PROTOCOL, WAYS, Network, Way
from pointsplat_ns.compression.trained_refiner import TrainedRefiner, load_refiner
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import read_ply, write_ply
from pointsplat_ns.io.source import source_file
from pointsplat_ns.pruning import method_named, resolve_keep, score_of, select
from pointsplat_ns.pruning.scores import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.refiner import read_metadata
from pointsplat_ns.system.programs import ProgramFailed, Usage, run_measured
from pointsplat_ns.system.progress import Progress
from pointsplat_ns.tradeoff.measuring import MadeScene, make
from pointsplat_ns.tradeoff.settings import DENSE, EFFORTS, Setting


class Tools:
    """The tools of cells besides the package: weights, and splat-transform, by default that on PATH, when first
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
    training: str
    """How the network was trained, as far as its file says: steps, loss, rates, supervision."""

    @cached_property
    def digest(self) -> str:
        """The first 12 hexadecimal digits of the file's SHA-256."""
        return source_file(self.refiner.source).sha256[:12]

    @property
    def network(self) -> Network:
        """Description of the network and its training."""
        config, settings = self.refiner.network.config, self.refiner.settings
        weight = settings.opacity_weight
        if weight is None and method_named(settings.by).weighs_opacity:
            weight = DEFAULT_OPACITY_WEIGHT
        return Network(config.encoder, settings.by, weight, config.use_appearance, config.use_position)

    @property
    def text(self) -> str:
        """One line that identifies the weights."""
        parameters = sum(parameter.numel() for parameter in self.refiner.network.parameters())
        keeps = ", ".join(f"{keep:g}" for keep in self.keeps)
        norm = self.refiner.network.config.norm
        words = [f"{parameters:,} parameters", f"norm by {norm}", f"{self.network}, keep {keeps}"]
        words += [self.training] if self.training else []
        words += [f"{len(self.trained_on)} scenes"] if self.trained_on else []
        return f"weights {self.digest} ({'; '.join(words)})"


class Refiners:
    """Weights to choose from; paths and errors are those of :func:`pointsplat_ns.load_refiner`."""

    def __init__(self, paths: Sequence[Path]):
        self.all = tuple(map(_read, paths))

    def find(self, network: Network, share: float, scene: str) -> tuple[Weights | None, str]:
        """The weights for a row (the needed network, a share of the Gaussians, the name of a scene), or the reason for
        none. They were trained for this network and this share, and not on the scene itself. Of several, the first is
        taken."""
        fitting = [
            weights
            for weights in self.all
            if weights.network == network and any(math.isclose(keep, share, rel_tol=1e-3) for keep in weights.keeps)
        ]
        for weights in fitting:
            if scene not in weights.trained_on:
                return weights, ""
        if fitting:
            return None, f"its weights ({fitting[0].path}) were trained on this scene"
        missing = f"no weights were given (--refiners) of a {network}, to {100 * share:g} %"
        return None, f"{missing}; to train them: {network.command(share)}"


def _read(path: Path) -> Weights:
    inside = path / "refiner.safetensors"  # of a finished training; a checkpoint does not name its training scenes
    file = inside if path.is_dir() and inside.is_file() else path
    metadata = read_metadata(file) if file.suffix.lower() == ".safetensors" else {}
    refiner = load_refiner(file)
    more = metadata.get("more_keeps")
    more = [keep for keep in more if isinstance(keep, (int, float))] if isinstance(more, list) else []
    known = {name: metadata[name] for name in TRAINING_SETTINGS if isinstance(metadata.get(name), (str, int, float))}
    training = ", ".join(f"{name.replace('_', ' ')} {value}" for name, value in known.items())
    return Weights(path, refiner, _names(metadata.get("scenes")), (refiner.settings.keep, *more), training)


TRAINING_SETTINGS = (
    "size", "steps", "supervision", "pixel_loss", "lpips_weight", "lpips_net", "rates", "rate_factor", "schedule",
)  # fmt: skip
"""Entries of a refiner's metadata that a row of a table names."""


def _names(scenes: Any) -> frozenset[str]:
    """Names of scenes from metadata: a list, or text with commas."""
    words = scenes.split(",") if isinstance(scenes, str) else scenes if isinstance(scenes, list) else []
    return frozenset(str(word).strip() for word in words if str(word).strip())


@dataclass(frozen=True)
class Reducer:
    """A program that reads a PLY and writes a smaller one."""

    label: str
    command: Callable[[Path, int, Path], list[str]]
    """The command line for a PLY to read, a number of Gaussians, and a PLY to write."""

    def reduce(self, source: Path, count: int, timeout: float | None = None) -> tuple[Gaussians, Usage]:
        """Run the program on a PLY, to keep ``count`` Gaussians: the smaller scene, and the cost with reading and
        writing. No file is left beside the PLY. Raises ProgramFailed if it fails, takes longer than ``timeout`` seconds
        or writes no file, and SceneError if its file cannot be read."""
        with tempfile.TemporaryDirectory(dir=source.parent) as folder:
            target = Path(folder) / "small.ply"
            args = self.command(source, count, target)
            usage = run_measured(args, timeout)
            if not target.is_file():
                raise ProgramFailed(f"{shlex.join(args)} ended well but wrote no file")
            return read_ply(target), usage


class SplatTransform:
    """splat-transform on the CPU.

    Attributes:
        version: such as "3.7.0".
        missing: the reason why it cannot be run; empty if it can.
        modes: its modes of decimation: ``--decimate``, and from version 3 on ``--decimate-adaptive``.

    Args:
        program: the path of the program; by default the one of this name on PATH. npx would run one of the current
            folder, which may be a stranger's.
    """

    def __init__(self, program: str | None = None):
        name = WAYS.splat_transform.name
        self.command = [program or shutil.which(name) or name]
        self.version = self.missing = ""
        self.modes: tuple[Reducer, ...] = ()
        try:
            found = subprocess.run(
                [*self.command, "--version"], stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=120
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            self.missing = f"{self.command[0]}: {error.__class__.__name__}"
            return
        version = re.search(r"(?:^|\s)v((\d{1,6})\.[\w.+-]{1,40})(?=\s|$)", found.stdout + found.stderr)
        if found.returncode != 0 or version is None:
            self.missing = f"{' '.join(self.command)} ended with {found.returncode}; is Node's package installed?"
            return
        self.version = version[1]
        label = f"{name} {self.version}"
        if int(version[2]) < 3:
            self.modes = (self._mode(label, "--decimate"),)
        else:
            adaptive = self._mode(f"{label} adaptive", "--decimate-adaptive")
            self.modes = (self._mode(f"{label} -d", "--decimate"), adaptive)

    def _mode(self, label: str, option: str) -> Reducer:
        def command(source: Path, count: int, target: Path) -> list[str]:
            return [*self.command, "-w", "-g", "cpu", str(source), option, str(count), str(target)]

        return Reducer(label, command)
