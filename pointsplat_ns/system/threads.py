"""Pieces of work on several threads, and the cores that there are for them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import torch

Item = TypeVar("Item")


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def in_threads(function: Callable[[Item], object], items: Sequence[Item]) -> None:
    """Call a function with each item, on as many threads as torch uses; torch uses one thread inside each.

    One operation on a small piece that stays in the cache is faster on one thread than shared between several, which
    wait for one another. Calls must not depend on each other.
    """
    count = min(torch.get_num_threads(), len(items))
    if count <= 1:
        for item in items:
            function(item)
        return
    with ThreadPoolExecutor(count, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        for _ in pool.map(function, items):
            pass
