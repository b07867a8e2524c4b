"""Memory allocation of this process."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

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


class PeakMemory:
    """The most memory that this process holds from here on, as Linux counts it (resident, freed memory given back
    first).

    Example:
        >>> peak = PeakMemory()
        >>> filled = bytearray(10**8)
        >>> peak.bytes() is None or peak.bytes() >= 10**8
        True
    """

    def __init__(self) -> None:
        self._known = False
        try:
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5")  # resets the high-water mark to what is resident now
            self._known = True
        except (OSError, AttributeError, TypeError):
            pass  # another system or C library

    def bytes(self) -> int | None:
        """The peak so far; None where it cannot be known."""
        if not self._known:
            return None
        for line in Path("/proc/self/status").read_text("utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
        return None
