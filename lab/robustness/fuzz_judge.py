"""Judges what a reader makes of bytes: a result or one typed error, at once, and in little memory."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Literal

from lab.common.timing import start_of_peak, status_bytes
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians

SECONDS = 5.0
"""Longest time of one input, of the processor."""

MEMORY = 16 << 20
"""Bytes that an input of a few kB may take, beyond twice its size and four times the scene in it."""


class Wrong(Exception):
    """A reader did what it must not: another exception, a hang, too much memory."""


def judge(read: Callable[[bytes], object], data: bytes) -> Literal["read", "refused"]:
    """What a reader does with bytes.

    Raises:
        Wrong: if that is neither a result nor one typed error in one line, or takes too long or too much memory.
    """
    size = 0
    try:
        start_of_peak()
        before = status_bytes("VmRSS")
    except OSError:  # not counted on this system
        before = None
    try:
        with _cpu_time_limited():
            result = read(data)
        if isinstance(result, Gaussians):
            size = sum(value.numel() * value.element_size() for value in result.tensors())
        del result
        outcome: Literal["read", "refused"] = "read"
    except PointSplatError as error:
        outcome = "refused"
        if "\n" in str(error) or not str(error).strip():
            raise Wrong(f"an error that is not one line: {str(error)!r:.200}") from error
        error.__traceback__ = None
    except _TooLong as error:
        raise Wrong(f"more than {SECONDS:g} s at {_place(error.__traceback__)}") from None
    except Exception as error:
        text = str(error).splitlines()[0][:120] if str(error) else ""
        raise Wrong(f"{type(error).__name__} at {_place(error.__traceback__)}: {text}") from error
    taken = 0 if before is None else status_bytes("VmHWM") - before
    if taken > MEMORY + 2 * len(data) + 4 * size:
        raise Wrong(f"took {taken / 1e6:.0f} MB for {len(data)} bytes")
    return outcome


def _place(trace: TracebackType | None) -> str:
    """Where in the package something happened."""
    frames = traceback.extract_tb(trace)
    ours = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames if "pointsplat_ns" in frame.filename]
    return ours[-1] if ours else f"? ({Path(frames[-1].filename).name}:{frames[-1].lineno})"


class _TooLong(BaseException):
    pass


@contextmanager
def _cpu_time_limited() -> Iterator[None]:
    def late(*_: object) -> None:
        raise _TooLong

    before = signal.signal(signal.SIGPROF, late)
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)
