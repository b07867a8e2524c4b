"""Pruned scenes, each computed once, in one thread ahead of the steps that use them, and kept while there is room."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable, Hashable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.nerfstudio_plugin.frames import MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refiner import Structure
from pointsplat_ns.system.threads import most_threads

Value = TypeVar("Value")


class Background:
    """Makes values in one thread, one after the other in the order in which they were asked for. Whoever takes a value
    gets what its making gives or raises, whenever that happened.

    The thread must not use a GPU: torch initialises CUDA's libraries in the first thread that needs them, and not
    safely. Only one thread at a time may call the methods but :meth:`check`.
    """

    def __init__(self) -> None:
        self._coming: dict[Hashable, Future[Any]] = {}
        self._pool: ThreadPoolExecutor | None = None
        self._stopping = threading.Event()

    def start(self, key: Hashable, make: Callable[[], Any]) -> None:
        """Make a value in the background, unless one with this key is being made or waits to be taken."""
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "background", torch.set_num_threads, (most_threads(),))
        if key not in self._coming:
            self._coming[key] = self._pool.submit(make)

    def take(self, key: Hashable, make: Callable[[], Value]) -> Value:
        """A value that was started, once it is made; if there is none, ``make`` it here and now."""
        future = self._coming.pop(key, None)
        return make() if future is None else future.result()

    def check(self, *_: object) -> None:
        """To be called now and then while a value is made. Raises InterruptedError if it is no longer needed."""
        if self._stopping.is_set():
            raise InterruptedError("the training has ended")

    def stop(self) -> None:
        """Drop all values and wait for the thread, which ends at the next :meth:`check` or value."""
        self._coming.clear()
        if self._pool is not None:
            self._stopping.set()
            self._pool.shutdown(cancel_futures=True)
            self._stopping.clear()
            self._pool = None


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
        self._latest: tuple[Hashable, PrunedScene | None] = None, None

    def start(self, scene: DenseScene, settings: PruneSettings) -> None:
        """Prune a scene in the background, unless it is in memory. An error is raised by :meth:`get`."""
        key = "pruned", scene.name, settings
        if self.known(key) is None:
            self._background.start(key, functools.partial(self._prune, scene, settings))

    def known(self, key: Hashable) -> PrunedScene | None:
        """A pruned scene that is in memory."""
        return self._latest[1] if self._latest[0] == key else self._cache.get(key)

    def get(
        self,
        scene: DenseScene,
        settings: PruneSettings,
        device: torch.device | str,
        dense: Gaussians | None = None,
    ) -> PrunedScene:
        """A pruned scene and its neighbour tables, on the network's device. ``dense`` are the scene's Gaussians, if
        they have been read already. A PointSplatError that names the scene if the settings do not fit it."""
        key = "pruned", scene.name, settings
        pruned = self.known(key)
        if pruned is None:
            make = functools.partial(self._prune, scene, settings, dense)
            smaller, dense_count, seconds = self._background.take(key, make)
            CONSOLE.log(f"{scene.name}: kept {len(smaller):,} of {dense_count:,} Gaussians")
            smaller = smaller.to(device)
            pruned = PrunedScene(dense_count, smaller, self._prepare(smaller), seconds)
            self._cache.put(key, pruned)
        self._latest = key, pruned
        return pruned

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
