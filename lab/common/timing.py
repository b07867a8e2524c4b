"""Clocks and memory."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

_clock = time.perf_counter


def use_cpu_time() -> None:
    """From now on the clock counts CPU seconds of this process, which others on the machine do not
    stretch."""
    global _clock
    _clock = time.process_time


def now() -> float:
    """Seconds on the clock, after all work on a GPU is done."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return _clock()


def seconds_of(call: Callable[[], object]) -> float:
    """Seconds that a call takes."""
    start = now()
    call()
    return now() - start


def timed(
    functions: dict[Any, Callable[[], dict[Any, float]]], repeats: int, budget: float
) -> dict[Any, float]:
    """Call every function once a round and take medians, so that a busy moment of the machine hits
    all alike.

    Args:
        functions: each measures itself and returns seconds by name.
        repeats: rounds counted; one more comes before them, to warm up.
        budget: seconds after which no new round is begun. At least one round is counted: the first
            if it alone took more than half of the budget.
    """
    begin = time.perf_counter()
    rounds: list[dict[Any, float]] = []
    for i in range(repeats + 1):
        seconds: dict[Any, float] = {}
        for function in functions.values():
            seconds |= function()
        spent = time.perf_counter() - begin
        if i > 0 or spent > budget / 2:
            rounds.append(seconds)
        if rounds and spent + spent / (i + 1) > budget:
            break
    return {name: statistics.median([r[name] for r in rounds]) for name in rounds[0]}


def start_of_peak() -> None:
    """Set the high-water mark of this process to what is resident now (Linux).

    Raises:
        OSError: where the system does not offer that.
    """
    Path("/proc/self/clear_refs").write_text("5")


def status_bytes(field: str) -> int:
    """Bytes of a field of ``/proc/self/status``, such as ``VmHWM``.

    Raises:
        OSError: where there is no such field.
    """
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(field + ":"):
            return 1024 * int(line.split()[1])
    raise OSError(f"/proc/self/status has no {field}")
