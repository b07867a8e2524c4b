"""Pieces of work on several threads, and how many threads torch uses.

Threads that share one operation wait for one another at its end. Where there are more of them than free cores, one is
always late, and a step on two threads can take ten times as long as on one. :func:`suitable_threads` therefore uses as
many as cores are free. Pieces of work (:func:`in_threads`) do not wait, and use all.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system.cores import cores, free_cores

Item = TypeVar("Item")
Result = TypeVar("Result")

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


def in_turn(function: Callable[[Item], Result], items: Sequence[Item], device: torch.device) -> Iterator[Result]:
    """The results of a function of each item, in their order: computed on a CPU on :func:`most_threads` threads, torch
    using one inside each; for a GPU in this thread, as a GPU runs one operation of a process after the other, and not
    all of torch may be called there from several threads.

    One operation on a small piece that stays in the cache is faster on one thread than shared between several, which
    wait for one another. Calls must not depend on each other. torch takes gradients in them if it does here.
    """
    count = min(most_threads(), len(items)) if device.type == "cpu" else 1
    if count <= 1:
        yield from map(function, items)
        return
    grad, inference = torch.is_grad_enabled(), torch.is_inference_mode_enabled()

    def call(item: Item) -> Result:
        with torch.inference_mode(inference), torch.set_grad_enabled(grad):
            return function(item)

    with ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        yield from pool.map(call, items)


def in_threads(function: Callable[[Item], object], items: Sequence[Item], device: torch.device) -> None:
    """Call a function with each item as :func:`in_turn` does."""
    for _ in in_turn(function, items, device):
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


@contextmanager
def suitable_threads(device: torch.device | None = None) -> Iterator[None]:
    """Let torch use at most as many threads while the context is open as other programs leave cores to this process,
    and at least one.

    Nothing is chosen for a GPU, where ``OMP_NUM_THREADS`` is set, nor within another such context. A result must not
    depend on the choice, which depends on the load: use it for work that gives the same bits on any number of threads,
    or for which a tolerance is stated. A ``device`` of None is the CPU.
    """
    before, outer = torch.get_num_threads(), chosen.most
    on_cpu = device is None or device.type == "cpu"
    if not on_cpu or chosen.fixed or most_threads() <= 1 or THREADS_VARIABLE in os.environ:
        yield
        return
    chosen.most = min(most_threads(), cores())
    chosen.fixed = True
    try:
        torch.set_num_threads(min(chosen.most, free_cores()) if chosen.most > 1 else 1)
        yield
    finally:
        torch.set_num_threads(before)
        chosen.most, chosen.fixed = outer, False


def now(device: torch.device) -> float:
    """Seconds since any moment, once the device has done its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()
