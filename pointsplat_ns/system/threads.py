"""The cores of this process, pieces of work on several threads, and how many threads torch uses.

Threads that share one operation wait for one another at its end. Where other programs keep the cores busy, one of them
is always late, and a step on two threads can take ten times as long as on one. :func:`suitable_threads` therefore uses
all threads or one: twice a second it times a small operation on both.
"""

from __future__ import annotations

import functools
import logging
import math
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import torch

from pointsplat_ns.errors import PointSplatError

logger = logging.getLogger("pointsplat_ns")

Item = TypeVar("Item")

THREADS_VARIABLE = "OMP_NUM_THREADS"
"""Environment variable with the number of torch's threads. Where it is set, no other number is chosen."""


class Chosen(threading.local):
    """The choice of :func:`suitable_threads` in one thread of Python."""

    most: int | None = None
    """Number of threads that torch had before; None where nothing is chosen."""
    fixed: bool = False
    """Whether no other number may be chosen: within a step, or where work is in pieces."""


chosen = Chosen()


def most_threads() -> int:
    """Number of threads for pieces of work that do not wait for one another: as many as torch has, or had before fewer
    were chosen."""
    return torch.get_num_threads() if chosen.most is None else chosen.most


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread while the context is open: for operations too small to share, and for sums that must
    not be rounded in another way on another number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let torch use one thread while the context is open, and :func:`in_threads` as many as torch had: for long work
    whose result must not depend on the number of threads. Nothing is chosen in it."""
    before, outer = torch.get_num_threads(), (chosen.most, chosen.fixed)
    chosen.most, chosen.fixed = most_threads(), True
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        chosen.most, chosen.fixed = outer


def in_threads(function: Callable[[Item], object], items: Sequence[Item], device: torch.device) -> None:
    """Call a function with each item: on a CPU on :func:`most_threads` threads, torch using one inside each; for a GPU
    in this thread, as a GPU runs one operation of a process after the other, and not all of torch may be called there
    from several threads.

    One operation on a small piece that stays in the cache is faster on one thread than shared between several, which
    wait for one another. Calls must not depend on each other.
    """
    count = min(most_threads(), len(items)) if device.type == "cpu" else 1
    if count <= 1:
        for item in items:
            function(item)
        return
    with ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for _ in pool.map(function, items):
            pass


@contextmanager
def fixed_threads(count: int | None) -> Iterator[None]:
    """Let torch use so many threads while the context is open, here and in programs that are started, whatever would be
    chosen; None changes nothing. Raises PointSplatError if the number is below 1, or above 1024: the system does not
    start any number of threads, and torch ends the program then."""
    if count is None:
        yield
        return
    if not 1 <= count <= 1024:
        raise PointSplatError(f"{count} threads; expected 1 to 1024")
    before, variable = torch.get_num_threads(), os.environ.get(THREADS_VARIABLE)
    torch.set_num_threads(count)
    os.environ[THREADS_VARIABLE] = str(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        if variable is None:
            os.environ.pop(THREADS_VARIABLE, None)
        else:
            os.environ[THREADS_VARIABLE] = variable


class Load:
    """Whether other programs make torch's threads wait for one another.

    A look shares a small operation between threads: they stall if it takes 1.5 times as long as on one of them. The
    machine is looked at three times before the first step, and then every 0.5 s; the pause doubles with each look that
    finds threads stalling, up to 8 s, and halves with each other. Threads count as stalling while one of the latest
    three looks says so, as some looks find nothing on a busy machine. A look takes some milliseconds.

    ``seconds`` is called with a number of threads and a bound; it gives the seconds that a piece of work takes on so
    many threads, or any time above the bound once that is reached. ``clock`` gives the time, seconds.
    """

    def __init__(self, seconds: Callable[[int, float], float], clock: Callable[[], float] = time.monotonic):
        self._seconds, self._clock = seconds, clock
        self._looks: deque[bool] = deque(maxlen=3)  # whether threads stalled
        self._due, self._pause = -math.inf, 0.5
        self._told = False

    def stalls(self, count: int) -> bool:
        """Whether ``count`` threads stall, by the latest looks. If one is due, looks first."""
        while len(self._looks) < 3 or self._clock() >= self._due:
            bound = 1.5 * self._seconds(1, math.inf)
            stalled = self._seconds(count, bound) > bound
            self._looks.append(stalled)
            self._pause = min(2 * self._pause, 8.0) if stalled else max(self._pause / 2, 0.5)
            self._due = self._clock() + self._pause
        if all(self._looks) and not self._told:
            self._told = True
            logger.warning(
                "this machine is busy with other programs: torch's threads wait for one another, so one is used "
                "instead of %d for now; --threads or %s overrules that", count, THREADS_VARIABLE,
            )  # fmt: skip
        return any(self._looks)


@functools.cache
def _numbers() -> torch.Tensor:
    with torch.inference_mode(False):  # else they could be written to in that mode alone
        return torch.ones(1 << 17, device="cpu", dtype=torch.float32)


def shared_operations(count: int, bound: float) -> float:
    """Seconds that 100 operations on 0.5 MB take on so many threads, or those so far once they exceed ``bound``."""
    numbers, before = _numbers(), torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        numbers.mul_(1.0)  # starts the threads
        start = time.perf_counter()
        seconds = 0.0
        for _ in range(100):
            numbers.mul_(1.0)
            seconds = time.perf_counter() - start
            if seconds > bound:
                break
        return seconds
    finally:
        torch.set_num_threads(before)


machine = Load(shared_operations)
"""What is known of this machine: one for the process, so that looks are not repeated."""


@contextmanager
def suitable_threads(device: torch.device | None = None) -> Iterator[None]:
    """Let torch use all its threads while the context is open, or one if they stall just now.

    At most as many are used as the process has cores. Nothing is chosen for a GPU, where ``OMP_NUM_THREADS`` is set,
    nor within another such context. A result must not depend on the choice, which depends on the load: use it for work
    that gives the same bits on one thread and several, or for which a tolerance is stated. A ``device`` of None is the
    CPU.
    """
    before, outer = torch.get_num_threads(), chosen.most
    on_cpu = device is None or device.type == "cpu"
    if not on_cpu or chosen.fixed or most_threads() <= 1 or THREADS_VARIABLE in os.environ:
        yield
        return
    chosen.most = min(most_threads(), cores())
    chosen.fixed = True
    try:
        torch.set_num_threads(1 if chosen.most > 1 and machine.stalls(chosen.most) else chosen.most)
        yield
    finally:
        torch.set_num_threads(before)
        chosen.most, chosen.fixed = outer, False


def cores() -> int:
    """Number of cores that this process may use: as its affinity and the quotas of its control groups (those of a
    container, for one) allow."""
    allowed = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quota = cpu_quota()
    return allowed if quota is None else max(1, min(allowed, int(quota)))


@functools.cache
def cpu_quota(root: Path = Path("/")) -> float | None:
    """Number of cores that Linux's control groups allow this process, the least of its group and all above; None if
    there is no limit. ``proc`` and ``sys`` are below ``root``."""
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
