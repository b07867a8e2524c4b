"""The cores that this process may use, and those that other programs leave to it."""

from __future__ import annotations

import functools
import math
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple


class Limit(NamedTuple):
    """A limit on the cores of this process and others, and what they have used of it."""

    cores: float
    seconds: float
    """CPU time that all processes under the limit have used so far; 0 where it is not known."""


class Group(NamedTuple):
    """A control group of Linux that limits cores."""

    quota: float  # cores
    folder: Path


def cores() -> int:
    """Number of cores that this process may use: as its affinity and the quotas of its control groups (those of a
    container, for one) allow."""
    allowed, quota = len(_allowed()), cpu_quota()
    return allowed if quota is None else max(1, min(allowed, int(quota)))


def _allowed() -> list[int]:
    """Numbers of the cores that this process may be scheduled on."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [*range(os.cpu_count() or 1)]


class OtherPrograms:
    """Measures the mean number of cores that other programs take from this process from now on."""

    def __init__(self) -> None:
        self._before = self._read()

    @staticmethod
    def _read() -> tuple[float, float, list[Limit]]:
        """Seconds of the clock and of this process on cores, and all limits."""
        groups = [Limit(group.quota, _seconds_of(group.folder)) for group in limiting_groups()]
        return time.monotonic(), time.process_time(), [_machine(), *groups]

    def cores(self) -> float:
        """Mean number of cores, at most :func:`cores`. What others use of a machine counts only where the rest is less
        than a quota allows this process."""
        (start, own_before, before), (end, own_after, after) = self._before, self._read()
        if end <= start:
            return 0.0
        own = (own_after - own_before) / (end - start)
        used = ((now.seconds - then.seconds) / (end - start) for now, then in zip(after, before, strict=True))
        left = min(limit.cores - max(0.0, all_used - own) for limit, all_used in zip(after, used, strict=True))
        return min(max(0.0, cores() - left), float(cores()))


def _machine() -> Limit:
    """The cores that this process may be scheduled on; where the system does not say what is used, nothing is."""
    import psutil

    allowed = _allowed()
    try:
        times = psutil.cpu_times(percpu=True)
    except (OSError, psutil.Error):
        times = []
    seen = [times[number] for number in allowed if number < len(times)]  # a container may be shown fewer
    return Limit(len(seen) or len(allowed), sum(_busy(each) for each in seen))


def _busy(times) -> float:
    idle = times.idle + getattr(times, "iowait", 0.0)
    guests = getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)  # also part of the user time
    return sum(times) - idle - guests


class FreeCores:
    """Number of cores that other programs leave to this process, by a look at the machine at most once a second.

    What other programs use is rounded: half a core and more counts as one, because a program that never pauses gets two
    thirds of a core where two threads of this process compete with it for two.
    """

    PAUSE = 1.0
    """Least time between two looks, seconds: a look takes a millisecond."""
    FIRST = 0.1
    """How long the first look takes, seconds: the system counts time in hundredths."""

    def __init__(self) -> None:
        self._others: OtherPrograms | None = None
        self._looked, self._count = -math.inf, 1

    def __call__(self) -> int:
        """The number as the latest look found it, at least 1."""
        if time.monotonic() - self._looked >= self.PAUSE:
            others = self._others
            if others is None:
                others = OtherPrograms()
                time.sleep(self.FIRST)
            self._count = max(1, cores() - round(others.cores()))
            self._others, self._looked = OtherPrograms(), time.monotonic()
        return self._count


free_cores = FreeCores()
"""One for the process, so that looks are not repeated."""


def cpu_quota(root: Path = Path("/")) -> float | None:
    """Number of cores that Linux's control groups allow this process, the least of its group and all above; None if
    there is no limit. ``root`` as for :func:`limiting_groups`."""
    return min((group.quota for group in limiting_groups(root)), default=None)


@functools.cache
def limiting_groups(root: Path = Path("/")) -> tuple[Group, ...]:
    """Linux's control groups that limit the cores of this process: its group and those above. ``proc`` and ``sys`` are
    below ``root``."""
    try:
        lines = (root / "proc/self/cgroup").read_text("utf-8").splitlines()
    except OSError:
        return ()
    found = []
    for line in lines:
        _, controllers, group = (line.split(":", 2) + ["", ""])[:3]
        if controllers == "":  # version 2
            top, quota_of = root / "sys/fs/cgroup", _quota_v2
        elif "cpu" in controllers.split(","):
            top, quota_of = root / "sys/fs/cgroup" / controllers, _quota_v1
        else:
            continue
        folder = top / group.lstrip("/")
        # In a container, the group may be named as the host sees it, and be mounted as the top.
        folders = [each for each in (folder, *folder.parents) if each.is_relative_to(top)]
        found += [Group(quota, each) for each in folders if (quota := quota_of(each)) is not None]
    return tuple(found)


def _quota_v2(folder: Path) -> float | None:
    try:
        quota, period = (folder / "cpu.max").read_text("utf-8").split()
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _quota_v1(folder: Path) -> float | None:
    try:
        quota, period = (int((folder / f"cpu.cfs_{name}_us").read_text("utf-8")) for name in ("quota", "period"))
        return None if quota <= 0 else quota / period
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _seconds_of(folder: Path) -> float:
    """CPU time that a control group has used, seconds; 0 if it does not say."""
    with suppress(OSError, ValueError, IndexError):  # version 2
        words = (folder / "cpu.stat").read_text("utf-8").split()
        return int(words[words.index("usage_usec") + 1]) / 1e6
    with suppress(OSError, ValueError):  # version 1
        return int((folder / "cpuacct.usage").read_text("utf-8")) / 1e9
    return 0.0
