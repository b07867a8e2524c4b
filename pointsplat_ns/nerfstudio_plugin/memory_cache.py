"""An in-memory cache of bounded size for photos, dense and pruned scenes, and renders."""

from __future__ import annotations

import threading
from typing import Any, Generic, NamedTuple, TypeVar

from cachetools import LRUCache

Value = TypeVar("Value")


def free_memory_share(share: float = 0.25) -> int:
    """Bytes in a share of the memory that is available now."""
    try:
        import psutil

        return int(share * psutil.virtual_memory().available)
    except (ImportError, OSError):
        return 1 << 30  # the machine's free memory cannot be read


class CacheKey(Generic[Value]):
    """Base class of the keys of a :class:`MemoryCache`; its parameter is the type of the value. Each kind of value has
    a key class of its own, a frozen dataclass, so that two kinds cannot be confused."""


class _Entry(NamedTuple):
    value: Any
    num_bytes: int


class MemoryCache:
    """A least-recently-used cache for values of several kinds, bounded in bytes; a bound of 0 keeps nothing. Safe to
    share among threads. Values are not copied: do not write to them."""

    def __init__(self, max_bytes: int):
        self.max_bytes = max_bytes
        self._entries: LRUCache[CacheKey[Any], _Entry] = LRUCache(max_bytes, getsizeof=lambda entry: entry.num_bytes)
        self._lock = threading.Lock()

    @property
    def num_bytes(self) -> int:
        """Total size of the values, bytes."""
        return int(self._entries.currsize)

    def get(self, key: CacheKey[Value]) -> Value | None:
        """The value of ``key``, which then counts as just used; None if there is none."""
        with self._lock:
            entry = self._entries.get(key)
        return None if entry is None else entry.value

    def put(self, key: CacheKey[Value], value: Value, num_bytes: int) -> None:
        """Store a value, not None, and drop the least recently used ones until the bound holds. An earlier value of the
        same key is replaced. A value larger than the whole cache is not stored."""
        with self._lock:
            self._entries.pop(key, None)
            if num_bytes <= self.max_bytes:
                self._entries[key] = _Entry(value, num_bytes)

    def __len__(self) -> int:
        return len(self._entries)
