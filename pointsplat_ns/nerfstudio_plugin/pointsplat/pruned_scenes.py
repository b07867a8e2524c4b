"""Pruned scenes, each computed once, also in the background, and kept in memory while there is room."""

from __future__ import annotations

import dataclasses
import functools
import time
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.nerfstudio_plugin.frames import MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.background import Background
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refiner import Structure


@dataclass(frozen=True, eq=False)
class PrunedScene:
    """A pruned scene and what the network needs beside it."""

    dense_count: int
    pruned: Gaussians
    """On the device of the network."""
    structure: Structure | None
    """The neighbour tables of the pruned scene; None if it is empty."""
    seconds: float
    """Duration of pruning, without reading the scene."""


def pruned_key(scene: DenseScene, settings: PruneSettings) -> Hashable:
    """Key of a pruned scene in the cache."""
    return "pruned", scene.name, settings


class PrunedScenes:
    """Prunes scenes, or takes them from memory if they have been pruned before.

    Args:
        cache: keeps pruned scenes in memory. The latest one is kept even if the cache has no room for it.
        prepare: computes the neighbour tables that the network needs, on the network's device.
        background: prunes scenes ahead, on the CPU.
    """

    def __init__(
        self,
        cache: MemoryCache,
        prepare: Callable[[Gaussians], Structure | None],
        background: Background,
    ):
        self._cache, self._prepare, self._background = cache, prepare, background
        self._latest: tuple[Hashable, PrunedScene] | None = None

    def start(self, scene: DenseScene, settings: PruneSettings) -> None:
        """Prune a scene in the background, unless it is in memory. An error is raised by :meth:`get`."""
        key = pruned_key(scene, settings)
        if (self._latest is None or self._latest[0] != key) and self._cache.get(key) is None:
            self._background.start(key, functools.partial(self._prune, scene, settings))

    def get(
        self,
        scene: DenseScene,
        settings: PruneSettings,
        device: torch.device | str,
        dense: Gaussians | None = None,
    ) -> PrunedScene:
        """A pruned scene and its neighbour tables, on the network's device. ``dense`` are the scene's Gaussians, if
        they have been read already. A PointSplatError that names the scene if the settings do not fit it."""
        key = pruned_key(scene, settings)
        if self._latest is None or self._latest[0] != key:
            pruned = self._cache.get(key)
            if pruned is None:
                make = functools.partial(self._prune, scene, settings, dense)
                smaller, dense_count, seconds = self._background.take(key, make)
                CONSOLE.log(f"{scene.name}: kept {len(smaller):,} of {dense_count:,} Gaussians")
                smaller = smaller.to(device)
                pruned = PrunedScene(dense_count, smaller, self._prepare(smaller), seconds)
                self._cache.put(key, pruned, sum(tensor.nbytes for tensor in tensors_in(pruned)))
            self._latest = key, pruned
        return self._latest[1]

    def _prune(
        self, scene: DenseScene, settings: PruneSettings, dense: Gaussians | None = None
    ) -> tuple[Gaussians, int, float]:
        """The pruned scene on the CPU, the number of Gaussians of the dense one, and the seconds that pruning took."""
        dense = scene.dense(keep=False) if dense is None else dense
        start = time.perf_counter()
        try:
            pruned = settings.prune(dense, self._background.check)
        except PointSplatError as error:
            raise type(error)(f"{scene.source}: {error}") from error
        return pruned, len(dense), time.perf_counter() - start


def tensors_in(value: Any) -> Iterator[Tensor]:
    """Every tensor in a dataclass, tuple or list, at any depth."""
    if isinstance(value, Tensor):
        yield value
    elif dataclasses.is_dataclass(value) and not isinstance(value, type):
        for entry in dataclasses.fields(value):
            yield from tensors_in(getattr(value, entry.name))
    elif isinstance(value, (tuple, list)):
        for entry in value:
            yield from tensors_in(entry)
