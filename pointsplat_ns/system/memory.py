"""Memory allocation of this process."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of mallopt(3)


def keep_freed_memory() -> bool:
    """Let the process reuse freed memory instead of returning it to the system.

    By default glibc maps a new block for every allocation above 32 MB, and the system then clears it page by page. When
    training on a CPU, each step frees and allocates the same large tensors, and this can take more time than the
    arithmetic. The price: the process never returns memory until it ends. Without Linux and glibc, nothing is changed.

    Returns:
        Whether the setting was made.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False  # another C library
    return bool(mallopt(_M_MMAP_MAX, 0)) and bool(mallopt(_M_TRIM_THRESHOLD, -1))
