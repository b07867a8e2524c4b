"""CPU cores that this process may use, and those that other programs occupy."""

from __future__ import annotations

import functools
import math
import os
import time
from contextlib import suppress
from pathlib import Path


def cores() -> int:
    """Number of cores that this process may use, limited by its affinity and by the quotas of its
    control groups, such as those of a container."""
    return max(1, int(min(len(_allowed()), cpu_quota())))


def _allowed() -> list[int]:
    """Indices of the cores that this process may be scheduled on."""
    return (
        sorted(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else [*range(os.cpu_count() or 1)]
    )


def _usage() -> tuple[float, float, int, float]:
    """Wall-clock seconds; CPU seconds of this process; number of cores that it may be scheduled on;
    seconds of use of these cores by all programs, 0 if unknown."""
    import psutil

    allowed = _allowed()
    try:
        times = psutil.cpu_times(percpu=True)
    except (OSError, psutil.Error):
        times = []
    # a container may see fewer cores
    seen = [times[number] for number in allowed if number < len(times)]
    # User time includes guest time.
    not_busy = ("idle", "iowait", "guest", "guest_nice")
    busy = sum(sum(each) - sum(getattr(each, name, 0.0) for name in not_busy) for each in seen)
    return time.monotonic(), time.process_time(), len(seen) or len(allowed), busy


class OtherPrograms:
    """Measures the mean number of cores that other programs occupy, from its construction on."""

    def __init__(self) -> None:
        self.before = _usage()

    def cores(self) -> float:
        """Mean number of cores, at most :func:`cores`. Use by others counts only if it leaves fewer
        cores than this process's quota."""
        (start, own_before, _, before) = self.before
        (end, own_after, limit, after) = _usage()
        others = max(0.0, after - before - (own_after - own_before)) / max(end - start, 1e-9)
        return min(max(0.0, cores() - (limit - others)), float(cores()))


@functools.cache
def cpu_quota(root: Path = Path("/")) -> float:
    """Number of cores that Linux control groups (version 2) allow this process: the minimum over
    its group and the groups above; infinite if unlimited. ``proc`` and ``sys`` are below
    ``root``."""
    try:
        lines = (root / "proc/self/cgroup").read_text("utf-8").splitlines()
    except OSError:
        return math.inf
    top = root / "sys/fs/cgroup"
    least = math.inf
    for line in lines:
        if line.startswith("0::/"):
            folder = top / line[4:]
            # A container may see the host's group name, with the group mounted at the top.
            for each in (folder, *folder.parents):
                with suppress(OSError, ValueError, ZeroDivisionError):  # "max": no limit
                    quota, period = (each / "cpu.max").read_text("utf-8").split()
                    least = min(least, int(quota) / int(period))
                if each == top:
                    break
    return least
