"""Runs work on several threads, with single-threaded torch operations on each.

When torch shares an operation between threads, they busy-wait for one another at its end. Small
operations end often: two threads take as long as one, and ten times as long if another program
occupies one of the cores. Here torch uses one thread (:func:`one_thread_each`). Pieces of work
(:func:`in_turn`) and compiled kernels (:func:`pointsplat_ns.system.kernels.on_threads`) use all
threads, which sleep while they wait.
"""

from __future__ import annotations

import functools
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import copy_context
from typing import TypeVar

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system.cores import cores

Item = TypeVar("Item")
Result = TypeVar("Result")

THREADS_VARIABLE = "OMP_NUM_THREADS"
"""Environment variable with torch's number of threads. If it is set, the number may exceed the
number of cores."""

MOST_THREADS = 1024
"""Maximum number of threads, because the system does not start any number."""


class Own(threading.local):
    """State of :func:`one_thread_each` in one Python thread."""

    most: int | None = None
    """torch's number of threads before; None outside of the context."""


own = Own()


def most_threads() -> int:
    """Number of threads that share work: torch's, as set outside of :func:`one_thread_each`; no
    more than there are cores, unless ``OMP_NUM_THREADS`` is set."""
    if own.most is not None:
        return own.most
    threads = torch.get_num_threads()
    return threads if threads == 1 or THREADS_VARIABLE in os.environ else min(threads, cores())


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread inside of the context: for operations too small to share, and for
    sums whose rounding must not depend on the number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let torch use one thread inside of the context, while pieces of work and kernels use
    :func:`most_threads`. The result does not depend on their number."""
    outer = own.most
    own.most = most_threads()
    try:
        with one_thread():
            yield
    finally:
        own.most = outer


def pool(name: str, count: int, inside: int = 1) -> ThreadPoolExecutor:
    """Thread pool for one kind of work, with ``inside`` torch threads in each thread. Pools are
    reused, because starting threads would take a fifth of a small step."""
    return _pool(os.getpid(), name, count, inside)


@functools.cache
def _pool(process: int, name: str, count: int, inside: int) -> ThreadPoolExecutor:
    """Pool of a process: a forked process does not inherit threads."""
    return ThreadPoolExecutor(count, f"pointsplat-{name}", torch.set_num_threads, (inside,))


def in_turn(
    function: Callable[[Item], Result], items: Sequence[Item], device: torch.device, inside: int = 1
) -> Iterator[Result]:
    """Map a function over items, and yield the results in order.

    On a CPU, calls run on :func:`most_threads` threads, with ``inside`` threads for torch and
    kernels in each. For a GPU, they run in this thread, because a GPU runs one operation of a
    process at a time, and some torch functions must not be called from several threads there.

    An operation on a small piece that stays in the cache is faster on one thread than shared
    between several, which wait for one another. Calls must not depend on each other. They inherit
    torch's gradient mode and the context variables. All calls have ended when this returns, also
    after an error or Ctrl-C.
    """
    count = min(most_threads(), len(items)) if device.type == "cpu" else 1
    if count <= 1:
        yield from map(function, items)
        return
    grad = torch.is_grad_enabled()
    inference = torch.is_inference_mode_enabled()

    def call(item: Item) -> Result:
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return function(item)

    threads = pool("pieces", count, inside)
    futures = deque(threads.submit(copy_context().run, call, item) for item in items)
    try:
        while futures:
            result = futures[0].result()
            futures.popleft()
            yield result
    finally:
        for future in futures:
            future.cancel()
        wait(futures)


def in_threads(
    function: Callable[[Item], object], items: Sequence[Item], device: torch.device
) -> None:
    """Call a function for each item, as :func:`in_turn` does."""
    for _ in in_turn(function, items, device):
        pass


@contextmanager
def fixed_threads(count: int | None) -> Iterator[None]:
    """Let torch use ``count`` threads inside of the context, here and in child processes; None
    changes nothing. Raises PointSplatError if the number is below 1 or above 1024, because torch
    aborts the program if the system cannot start the threads."""
    if count is None:
        yield
        return
    if not 1 <= count <= MOST_THREADS:
        raise PointSplatError(f"{count} threads; expected 1 to {MOST_THREADS}")
    before = torch.get_num_threads()
    variable = os.environ.get(THREADS_VARIABLE)
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


def now(device: torch.device) -> float:
    """Seconds on a monotonic clock, after the device has finished its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
