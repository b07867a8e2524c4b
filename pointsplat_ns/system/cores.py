"""The cores that this process may use."""

from __future__ import annotations

import functools
import os
from pathlib import Path


def cores() -> int:
    """Number of cores that this process may use: as its affinity and the quotas of its control groups (those of a
    container, for one) allow."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cpu_quota()
    return allowed if quota is None else max(1, min(allowed, int(quota)))


@functools.cache
def cpu_quota(root: Path = Path("/")) -> float | None:
    """Number of cores that Linux's control groups allow this process, the least of its group and all above; None if
    there is no limit.

    Args:
        root: where ``proc`` and ``sys`` are.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text("utf-8").splitlines()
    except OSError:
        return None
    found = []
    for line in lines:
        _, controllers, group = (line.split(":", 2) + ["", ""])[:3]
        if controllers == "":  # version 2
            top, limit_of = root / "sys/fs/cgroup", _limit_v2
        elif "cpu" in controllers.split(","):
            top, limit_of = root / "sys/fs/cgroup" / controllers, _limit_v1
        else:
            continue
        folder = top / group.lstrip("/")
        # In a container, the group may be named as the host sees it, and be mounted as the top.
        found += [limit_of(each) for each in (folder, *folder.parents) if each.is_relative_to(top)]
    return min((limit for limit in found if limit is not None), default=None)


def _limit_v2(folder: Path) -> float | None:
    try:
        quota, period = (folder / "cpu.max").read_text("utf-8").split()
        return None if quota == "max" else int(quota) / int(period)
    except (OSError, ValueError, ZeroDivisionError):
        return None


def _limit_v1(folder: Path) -> float | None:
    try:
        quota, period = (int((folder / f"cpu.cfs_{name}_us").read_text("utf-8")) for name in ("quota", "period"))
        return None if quota <= 0 else quota / period
    except (OSError, ValueError, ZeroDivisionError):
        return None
