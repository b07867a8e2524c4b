"""Memory allocation of this process."""

from __future__ import annotations

import contextlib
import ctypes
import sys


def keep_freed_memory() -> None:
    """Let the process reuse freed memory instead of returning it to the system.

    By default glibc maps a new block for every allocation above 32 MB, and the system then clears
    it page by page. When training on a CPU, each step frees and allocates the same large tensors,
    and this can take more time than the arithmetic. The price: the process never returns memory
    until it ends. Without Linux and glibc, nothing is changed.
    """
    _set({-4: 0, -1: -1})  # M_MMAP_MAX, M_TRIM_THRESHOLD


def share_freed_memory() -> None:
    """Let threads that come and go reuse the memory of one another.

    By default glibc gives each new thread a place of its own to allocate from, up to eight for each
    core, and memory that was freed there serves no other. Threads that exist keep theirs. Without
    Linux and glibc, nothing is changed.
    """
    _set({-8: 2})  # M_ARENA_MAX: enough for a thread that draws and the others


def give_back_freed_memory() -> None:
    """Return freed memory to the system, between stages of long work that need it in blocks of
    other sizes: else what lies free between blocks counts as taken. Without Linux and glibc,
    nothing happens."""
    with contextlib.suppress(OSError, AttributeError, TypeError):
        ctypes.CDLL(None).malloc_trim(0)


def _set(values: dict[int, int]) -> None:
    """Set parameters of glibc's malloc by their numbers in mallopt(3), if that is possible."""
    if sys.platform.startswith("linux"):
        with contextlib.suppress(OSError, AttributeError):  # another C library
            mallopt = ctypes.CDLL("libc.so.6").mallopt
            for name, value in values.items():
                mallopt(name, value)
