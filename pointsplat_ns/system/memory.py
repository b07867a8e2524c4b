"""How this process gets its memory from the system."""

from __future__ import annotations

import ctypes
import sys

_M_TRIM_THRESHOLD, _M_MMAP_MAX = -1, -4  # of mallopt(3)


def keep_freed_memory() -> bool:
    """Let memory that is freed serve what is allocated next, instead of going back to the system at once.

    By default glibc maps every block above 32 MB afresh, and the system then clears it page by page. In a training on
    a CPU, whose steps free and allocate the same large tensors over and over, that can take more time than the
    arithmetic. The process keeps what it once had until it ends. Elsewhere than on Linux with glibc nothing happens.

    Returns:
        Whether it is so from now on.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL("libc.so.6").mallopt
    except (OSError, AttributeError):
        return False  # another C library
    return bool(mallopt(_M_MMAP_MAX, 0)) and bool(mallopt(_M_TRIM_THRESHOLD, -1))
