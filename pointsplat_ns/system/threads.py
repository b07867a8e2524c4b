"""Work on several threads, each of which computes on one.

Where torch shares an operation between threads, they wait for one another at its end, on their
cores, and small operations end often: two threads take as long as one, and ten times as long where
another program has one of the cores. Here torch uses one thread (:func:`one_thread_each`). Pieces
of work (:func:`in_turn`), and kernels of this package
(:func:`pointsplat_ns.system.kernels.on_threads`) use all, and sleep while they wait.
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
"""Environment variable with the number of torch's threads. Where it is set, more are used than
there are cores."""

MOST_THREADS = 1024
"""The system does not start any number of threads."""


class Own(threading.local):
    """What :func:`one_thread_each` found in one thread of Python."""

    most: int | None = None
    """Number of threads that torch had before; None outside."""


own = Own()


def most_threads() -> int:
    """Number of threads that share work here: as many as torch has, or had outside of
    :func:`one_thread_each`; no more than there are cores, unless ``OMP_NUM_THREADS`` says so."""
    if own.most is not None:
        return own.most
    threads = torch.get_num_threads()
    return threads if threads == 1 or THREADS_VARIABLE in os.environ else min(threads, cores())


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch use one thread while the context is open: for operations too small to share, and
    for sums that must not be rounded in another way on another number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Let torch use one thread while the context is open, and pieces of work and kernels
    :func:`most_threads`. The result does not depend on their number."""
    outer = own.most
    own.most = most_threads()
    try:
        with one_thread():
            yield
    finally:
        own.most = outer


def pool(name: str, count: int, inside: int = 1) -> ThreadPoolExecutor:
    """Threads for one kind of work, torch using ``inside`` in each. New threads for each use would
    take a fifth of a small step."""
    return _pool(os.getpid(), name, count, inside)


@functools.cache
def _pool(process: int, name: str, count: int, inside: int) -> ThreadPoolExecutor:
    """Threads of a process: those of one that forked are not the other's."""
    return ThreadPoolExecutor(count, f"pointsplat-{name}", torch.set_num_threads, (inside,))


def in_turn(
    function: Callable[[Item], Result], items: Sequence[Item], device: torch.device, inside: int = 1
) -> Iterator[Result]:
    """The results of a function of each item, in their order: computed on a CPU on
    :func:`most_threads` threads, torch and kernels using ``inside`` in each; for a GPU in this
    thread, as a GPU runs one operation of a process after the other, and not all of torch may be
    called there from several threads.

    One operation on a small piece that stays in the cache is faster on one thread than shared
    between several, which wait for one another. Calls must not depend on each other. torch takes
    gradients in them if it does here, and context variables have the values that they have here.
    No call runs any more when this ends, by an error or Ctrl-C, too.
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
    """Call a function with each item as :func:`in_turn` does."""
    for _ in in_turn(function, items, device):
        pass


@contextmanager
def fixed_threads(count: int | None) -> Iterator[None]:
    """Let torch use so many threads while the context is open, here and in programs that are
    started; None changes nothing. Raises PointSplatError if the number is below 1, or above 1024:
    the system does not start any number of threads, and torch ends the program then."""
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
    """Seconds since any moment, once the device has done its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
