"""The cores that this process may use, and those that other programs leave to it."""

from __future__ import annotations

import functools
import math
import os
import time
from contextlib import suppress
from pathlib import Path


def cores() -> int:
    """Number of cores that this process may use: as its affinity and the quotas of its control
    groups (those of a container, for one) allow."""
    return max(1, int(min(len(_allowed()), cpu_quota())))


def _allowed() -> list[int]:
    """Numbers of the cores that this process may be scheduled on."""
    return (
        sorted(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else [*range(os.cpu_count() or 1)]
    )


def _usage() -> tuple[float, float, int, float]:
    """Seconds of the clock, and of this process on cores; the number of cores that it may be
    scheduled on, and the seconds used of them by all programs, 0 if they are unknown."""
    import psutil

    allowed = _allowed()
    try:
        times = psutil.cpu_times(percpu=True)
    except (OSError, psutil.Error):
        times = []
    seen = [
        times[number] for number in allowed if number < len(times)
    ]  # a container may be shown fewer
    # Time of guests is part of the user time, too.
    not_busy = ("idle", "iowait", "guest", "guest_nice")
    busy = sum(sum(each) - sum(getattr(each, name, 0.0) for name in not_busy) for each in seen)
    return time.monotonic(), time.process_time(), len(seen) or len(allowed), busy


class OtherPrograms:
    """Measures the mean number of cores that other programs take from this process from now on."""

    def __init__(self) -> None:
        self.before = _usage()

    def cores(self) -> float:
        """Mean number of cores, at most :func:`cores`. What others use of a machine counts only
        where the rest is less than a quota allows this process."""
        (start, own_before, _, before) = self.before
        (end, own_after, limit, after) = _usage()
        others = max(0.0, after - before - (own_after - own_before)) / max(end - start, 1e-9)
        return min(max(0.0, cores() - (limit - others)), float(cores()))


@functools.cache
def cpu_quota(root: Path = Path("/")) -> float:
    """Number of cores that Linux's control groups (version 2) allow this process, the least of its
    group and all above; infinite if there is no limit. ``proc`` and ``sys`` are below ``root``."""
    try:
        lines = (root / "proc/self/cgroup").read_text("utf-8").splitlines()
    except OSError:
        return math.inf
    top = root / "sys/fs/cgroup"
    least = math.inf
    for line in lines:
        if line.startswith("0::/"):
            folder = top / line[4:]
            # In a container, the group may be named as the host sees it, and be mounted as the top.
            for each in (folder, *folder.parents):
                with suppress(OSError, ValueError, ZeroDivisionError):  # "max": no limit
                    quota, period = (each / "cpu.max").read_text("utf-8").split()
                    least = min(least, int(quota) / int(period))
                if each == top:
                    break
    return least
