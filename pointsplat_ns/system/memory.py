"""Memory allocation of this process."""

from __future__ import annotations

import contextlib
import ctypes
import sys


def keep_freed_memory() -> None:
    """Let the process reuse freed memory instead of returning it to the system.

    By default glibc maps a new block for every allocation above 32 MB, and the kernel then zeroes
    it page by page. When training on a CPU, each step frees and allocates the same large tensors,
    and this can take more time than the arithmetic. The cost: the process never returns memory
    until it ends. No effect without Linux and glibc.
    """
    _set({-4: 0, -1: -1})  # M_MMAP_MAX, M_TRIM_THRESHOLD


def share_freed_memory() -> None:
    """Let short-lived threads reuse each other's memory.

    By default glibc gives each new thread its own arena, up to eight per core, and memory freed in
    one arena is not reused in another. Existing threads keep their arenas. No effect without Linux
    and glibc.
    """
    _set({-8: 2})  # M_ARENA_MAX: enough for a rendering thread and the others


def give_back_freed_memory() -> None:
    """Return freed memory to the system, between stages of long work that allocate blocks of other
    sizes. Without this, fragmented free memory counts as used. No effect without Linux and
    glibc."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _set(values: dict[int, int]) -> None:
    """Set parameters of glibc's malloc by their numbers in mallopt(3), if possible."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):  # another C library
            mallopt = ctypes.CDLL("libc.so.6").mallopt
            for name, value in values.items():
                mallopt(name, value)
