"""Pieces of work on several threads, and how many there may be."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch

from pointsplat_ns.errors import PointSplatError

Item = TypeVar("Item")

ENVIRONMENT = "OMP_NUM_THREADS"
"""Environment variable with the number of torch's threads. Where it is set, no other number is chosen."""


class Chosen(threading.local):
    """What :mod:`~pointsplat_ns.system.thread_choice` has chosen for this thread of Python."""

    most: int | None = None
    """Number of threads that were chosen from; None where nothing is chosen."""
    settled: bool = False
    """Whether the number of threads is settled, so that none is chosen: a step is measured, or work is in pieces."""


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
    before, outer = torch.get_num_threads(), (chosen.most, chosen.settled)
    chosen.most, chosen.settled = most_threads(), True
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        chosen.most, chosen.settled = outer


def in_threads(function: Callable[[Item], object], items: Sequence[Item]) -> None:
    """Call a function with each item, on :func:`most_threads` threads; torch uses one thread inside each.

    One operation on a small piece that stays in the cache is faster on one thread than shared between several, which
    wait for one another. Calls must not depend on each other.
    """
    count = min(most_threads(), len(items))
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
    chosen; None changes nothing.

    Raises:
        PointSplatError: if the number is below 1.

    Example:
        >>> with fixed_threads(1):
        ...     torch.get_num_threads()
        1
    """
    if count is None:
        yield
        return
    if count < 1:
        raise PointSplatError(f"{count} threads; expected at least 1")
    before, variable = torch.get_num_threads(), os.environ.get(ENVIRONMENT)
    torch.set_num_threads(count)
    os.environ[ENVIRONMENT] = str(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
        if variable is None:
            os.environ.pop(ENVIRONMENT, None)
        else:
            os.environ[ENVIRONMENT] = variable
