"""Finds the weights for a row of the tables among given files, by the metadata of each file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from pointsplat_ns.compression.trained_refiner import TrainedRefiner, load_refiner
from pointsplat_ns.io.source import source_file
from pointsplat_ns.pruning import method_named
from pointsplat_ns.pruning.scores import DEFAULT_OPACITY_WEIGHT
from pointsplat_ns.refiner import read_metadata
from pointsplat_ns.tables.ways import Network


@dataclass(frozen=True, eq=False)
class Weights:
    """A trained refiner."""

    path: Path
    """Path as given."""
    refiner: TrainedRefiner
    trained_on: frozenset[str]
    """Names of training scenes; empty if they are not known."""

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
        return f"weights {self.digest} ({self.network}, keep {self.refiner.settings.keep:g})"


class Refiners:
    """Weights to choose from; paths and errors are those of :func:`pointsplat_ns.load_refiner`."""

    def __init__(self, paths: Sequence[Path]):
        self.all = tuple(map(_read, paths))

    def find(self, network: Network, share: float, scene: str) -> tuple[Weights | None, str]:
        """The weights for a row (the needed network, a share of the Gaussians, the name of a scene), or the reason for
        none. Of several, those with the training budget nearest to ``share`` are taken, by ratio. Weights trained on
        the scene itself are excluded."""
        fitting = [weights for weights in self.all if weights.network == network]
        unseen = [weights for weights in fitting if scene not in weights.trained_on]
        if unseen:
            return min(unseen, key=lambda weights: _distance(weights.refiner.settings.keep, share)), ""
        if fitting:
            return None, f"its weights ({fitting[0].path}) were trained on this scene"
        return None, f"no weights were given (--refiners) of a {network}"


def _distance(keep: float | int, share: float) -> float:
    """Distance of a training budget from a share; infinite for budgets in Gaussians."""
    return abs(math.log(keep / share)) if keep <= 1 else math.inf


def _read(path: Path) -> Weights:
    inside = path / "refiner.safetensors"  # of a finished training; a checkpoint does not name its training scenes
    file = inside if path.is_dir() and inside.is_file() else path
    metadata = read_metadata(file) if file.suffix.lower() == ".safetensors" else {}
    return Weights(path, load_refiner(file), _names(metadata.get("scenes")))


def _names(scenes: Any) -> frozenset[str]:
    """Names of scenes from metadata: a list, or text with commas."""
    words = scenes.split(",") if isinstance(scenes, str) else scenes if isinstance(scenes, list) else []
    return frozenset(str(word).strip() for word in words if str(word).strip())
