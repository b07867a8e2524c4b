"""Values kept in memory up to a number of bytes: photos, dense and pruned scenes, renders."""

from __future__ import annotations

import threading
from typing import Any, Generic, NamedTuple, TypeVar

from cachetools import LRUCache

FALLBACK_BYTES = 1 << 30
"""Size of a cache where the machine's free memory cannot be read."""

Value = TypeVar("Value")


def free_memory_share(share: float = 0.25) -> int:
    """Bytes in a share of the memory that is available now."""
    try:
        import psutil

        return int(share * psutil.virtual_memory().available)
    except (ImportError, OSError):
        return FALLBACK_BYTES


class CacheKey(Generic[Value]):
    """What names a value in a :class:`MemoryCache`, and says its type.

    Each kind of value has a key class of its own, a frozen dataclass, so that no two kinds can be mixed up::

        @dataclass(frozen=True)
        class PhotoKey(CacheKey[Photo]):
            dataset: str
            index: int
    """


class _Entry(NamedTuple):
    value: Any
    num_bytes: int


class MemoryCache:
    """Values of any kinds up to a number of bytes, the longest unused dropped first.

    Safe to share among threads. A value is handed out as it was put in, not copied: do not write to it.

    Args:
        max_bytes: bound on the sum of the sizes of what is kept; 0 keeps nothing.
    """

    def __init__(self, max_bytes: int):
        self.max_bytes = max_bytes
        self._entries: LRUCache[CacheKey[Any], _Entry] = LRUCache(max_bytes, getsizeof=lambda entry: entry.num_bytes)
        self._lock = threading.Lock()

    @property
    def num_bytes(self) -> int:
        """Size of what is kept."""
        return int(self._entries.currsize)

    def get(self, key: CacheKey[Value]) -> Value | None:
        """What is kept under ``key``, which then counts as just used; None if nothing is."""
        with self._lock:
            entry = self._entries.get(key)
        return None if entry is None else entry.value

    def put(self, key: CacheKey[Value], value: Value, num_bytes: int) -> None:
        """Keep a value, and drop the longest unused ones until the bound holds.

        Args:
            key: replaces what was kept under it.
            value: not None.
            num_bytes: the size of the value. One larger than the whole cache is not kept.
        """
        with self._lock:
            self._entries.pop(key, None)
            if num_bytes <= self.max_bytes:
                self._entries[key] = _Entry(value, num_bytes)

    def __len__(self) -> int:
        return len(self._entries)
