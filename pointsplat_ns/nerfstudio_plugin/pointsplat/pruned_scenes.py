"""Pruned scenes, each computed once, also in the background: kept in memory while there is room, and on disk if a
folder is given."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.files import file_stem, one_line, write_tensors
from pointsplat_ns.nerfstudio_plugin.frames import CacheKey, MemoryCache
from pointsplat_ns.nerfstudio_plugin.pointsplat.background import Background
from pointsplat_ns.nerfstudio_plugin.pointsplat.dense_scenes import DenseScene
from pointsplat_ns.pruning import PruneSettings
from pointsplat_ns.refiner import Structure

PRUNED_FORMAT = "pointsplat-pruned/1"
"""Must change whenever the result of a pruning method changes, so that older files are not used."""


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


@dataclass(frozen=True)
class PrunedKey(CacheKey[PrunedScene]):
    """Key of a pruned scene in a cache that several scenes share."""

    scene: str
    settings: PruneSettings


class PrunedScenes:
    """Prunes scenes, or takes them from memory or disk if they have been pruned before.

    Args:
        cache: keeps pruned scenes in memory. The latest one is kept even if the cache has no room for it.
        folder: keeps pruned scenes on disk, by the content of the dense scene's file; None keeps none.
        prepare: computes the neighbour tables that the network needs, on the network's device.
        background: prunes scenes ahead, on the CPU.
    """

    def __init__(
        self,
        cache: MemoryCache,
        folder: Path | None,
        prepare: Callable[[Gaussians], Structure | None],
        background: Background,
    ):
        self._cache, self._folder, self._prepare, self._background = cache, folder, prepare, background
        self._latest: tuple[PrunedKey, PrunedScene] | None = None

    def start(self, scene: DenseScene, settings: PruneSettings) -> None:
        """Prune a scene in the background, unless it is in memory. An error is raised by :meth:`get`."""
        key = PrunedKey(scene.name, settings)
        if (self._latest is None or self._latest[0] != key) and self._cache.get(key) is None:
            self._background.start(key, functools.partial(self._read_or_prune, scene, settings))

    def get(
        self,
        scene: DenseScene,
        settings: PruneSettings,
        device: torch.device | str,
        dense: Gaussians | None = None,
    ) -> PrunedScene:
        """A pruned scene and its neighbour tables, on the network's device. ``dense`` are the scene's Gaussians, if
        they have been read already. A PointSplatError that names the scene if the settings do not fit it."""
        key = PrunedKey(scene.name, settings)
        if self._latest is None or self._latest[0] != key:
            pruned = self._cache.get(key)
            if pruned is None:
                make = functools.partial(self._read_or_prune, scene, settings, dense)
                smaller, dense_count, seconds = self._background.take(key, make)
                CONSOLE.log(f"{scene.name}: kept {len(smaller):,} of {dense_count:,} Gaussians")
                smaller = smaller.to(device)
                pruned = PrunedScene(dense_count, smaller, self._prepare(smaller), seconds)
                self._cache.put(key, pruned, sum(tensor.nbytes for tensor in tensors_in(pruned)))
            self._latest = key, pruned
        return self._latest[1]

    def _read_or_prune(
        self, scene: DenseScene, settings: PruneSettings, dense: Gaussians | None = None
    ) -> tuple[Gaussians, int, float]:
        """Read a pruned scene from the folder, or prune the scene now and save it there. The pruned scene on the CPU,
        the number of Gaussians of the dense one, and the seconds that pruning took."""
        stored = None if self._folder is None else stored_path(self._folder, scene.name, scene.content, settings)
        if stored is not None and stored.is_file():
            return read_pruned(stored)
        dense = scene.dense(keep=False) if dense is None else dense
        start = time.perf_counter()
        try:
            pruned = settings.prune(dense, self._background.check)
        except PointSplatError as error:
            raise type(error)(f"{scene.source}: {error}") from error
        dense_count, seconds = len(dense), time.perf_counter() - start
        if stored is not None:
            write_pruned(stored, pruned, dense_count, seconds)
        return pruned, dense_count, seconds


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


def stored_path(folder: Path, name: str, content: str, settings: PruneSettings) -> Path:
    """The path of a pruned scene's file, by the SHA-256 of the file that the dense scene is read from and by how it is
    pruned: a scene that is trained again has another one. The name is for people who look into the folder."""
    described = json.dumps([PRUNED_FORMAT, content, dataclasses.asdict(settings)], sort_keys=True)
    return folder / f"{file_stem(name)}-{hashlib.sha256(described.encode()).hexdigest()[:16]}.safetensors"


def write_pruned(path: Path, pruned: Gaussians, dense_count: int, seconds: float) -> None:
    """Write a pruned scene, the number of Gaussians of the dense scene, and the seconds that pruning took."""
    header = {"format": PRUNED_FORMAT, "dense_count": str(dense_count), "seconds": repr(seconds)}
    header |= {"antialiased": str(pruned.antialiased), "traits": json.dumps(pruned.traits)}
    write_tensors(path, dict(pruned.items()), header)


def read_pruned(path: Path) -> tuple[Gaussians, int, float]:
    """The scene on the CPU, the dense count and the seconds of a file of :func:`write_pruned`. Raises SceneError if the
    file is damaged or of another kind."""
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            if header.get("format") != PRUNED_FORMAT:
                raise SceneError(
                    f"{path}: format {header.get('format')!r}; expected {PRUNED_FORMAT!r}; remove the file"
                )
            pruned = Gaussians(
                **{name: file.get_tensor(name) for name in file.keys()},
                antialiased=header.get("antialiased") == "True",
            )
            _, up, offset = json.loads(header.get("traits", "[false, null, null]"))
            pruned = pruned.replace(up=up, offset=None if offset is None else tuple(offset))
            return pruned, int(header["dense_count"]), float(header["seconds"])
    except (SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise SceneError(f"{path}: not a readable pruned scene ({one_line(error)}); remove the file") from error
