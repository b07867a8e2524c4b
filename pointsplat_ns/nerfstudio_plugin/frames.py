"""Posed photos, loaded lazily, and a cache of bounded size for photos, scenes and renders."""

from __future__ import annotations

import copy
import dataclasses
import threading
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Literal

import psutil
import torch
from cachetools import LRUCache
from nerfstudio.cameras.cameras import Cameras


class MemoryCache:
    """A least-recently-used cache for values of several kinds, which their keys tell apart, bounded in bytes; a bound
    of 0 keeps nothing. Safe to share among threads. Values are not copied: do not write to them."""

    def __init__(self, max_bytes: int):
        self._entries: LRUCache[Hashable, tuple[Any, int]] = LRUCache(max_bytes, getsizeof=lambda entry: entry[1])
        self._lock = threading.Lock()

    @classmethod
    def of(cls, gigabytes: float | None = None) -> MemoryCache:
        """A cache of this size, 10^9 bytes; by default of a quarter of the memory that is free now."""
        return cls(psutil.virtual_memory().available // 4 if gigabytes is None else int(gigabytes * 1e9))

    def get(self, key: Hashable) -> Any:
        """The value of ``key``, which then counts as just used; None if there is none."""
        with self._lock:
            entry = self._entries.get(key)
        return None if entry is None else entry[0]

    def put(self, key: Hashable, value: Any) -> None:
        """Store a value, not None, by the size of its tensors, and drop the least recently used ones until the bound
        holds. A value larger than the whole cache is not stored."""
        size = tensor_bytes(value)
        with self._lock:
            if size <= self._entries.maxsize:
                self._entries[key] = value, size


def tensor_bytes(value: Any) -> int:
    """Bytes of all tensors in a dictionary, list, tuple or dataclass, at any depth."""
    if isinstance(value, torch.Tensor):
        return value.nbytes
    if dataclasses.is_dataclass(value):
        value = vars(value)
    parts = value.values() if isinstance(value, Mapping) else value if isinstance(value, (list, tuple)) else ()
    return sum(map(tensor_bytes, parts))


Frame = tuple[Cameras, dict[str, Any]]
"""A camera of shape (1,), and what nerfstudio calls its data: a dictionary with the photo, its mask and its index."""


class Frames(Sequence[Frame]):
    """The posed photos of one split of a dataset: an
    :class:`~pointsplat_ns.nerfstudio_plugin.undistorted.UndistortedDataset`, or another with ``cameras``, a length and
    ``get_data``.

    ``frames[i]`` is ``(camera, data)``: a nerfstudio camera of shape (1,) without lens distortion, and a fresh
    dictionary with ``image`` (H, W, 3 or 4; uint8 or float32 in [0, 1]), ``mask`` (H, W, 1) bool where the dataset has
    masks, and ``image_idx``, all on ``device``. The tensors are shared with the cache, which by default takes a quarter
    of the free memory: do not write to them. A photo or mask that cannot be used is a DataError.
    """

    def __init__(
        self,
        dataset: Any,
        image_type: Literal["uint8", "float32"] = "uint8",
        cache: MemoryCache | None = None,
        device: torch.device | str = "cpu",
    ):
        self.dataset, self.device = dataset, device
        self.image_type: Literal["uint8", "float32"] = image_type
        self.cache = MemoryCache.of() if cache is None else cache
        self._owner = object()

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: int) -> Frame:  # type: ignore[override]
        index = range(len(self))[index]
        key = "photo", self._owner, index
        frame = self.cache.get(key)
        if frame is None:
            frame = self.dataset.cameras[index : index + 1], self.dataset.get_data(index, image_type=self.image_type)
            self.cache.put(key, frame)
        camera, data = frame
        moved = {name: data[name].to(self.device) for name in ("image", "mask") if name in data}
        return copy.deepcopy(camera).to(self.device), {**data, **moved}
