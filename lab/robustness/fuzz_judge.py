"""Judges what a reader makes of bytes: a result or one typed error, at once, and in little memory."""

from __future__ import annotations

import signal
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

from fuzz_readers import Read

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians

SECONDS = 5.0
"""Longest time of one input, of the processor."""

MEMORY = 16 << 20
"""Bytes that an input of a few kB may take, beyond twice its size and what the scene in it takes."""

Outcome = Literal["read", "refused"]


class Wrong(Exception):
    """A reader did what it must not: another exception, a hang, too much memory."""


def judge(read: Read, data: bytes) -> Outcome:
    """What a reader does with bytes.

    Raises:
        Wrong: if that is neither a result nor one typed error in one line, or takes too long or too much memory.
    """
    before = _start_of_peak()
    size = 0
    try:
        with _cpu_time_limited():
            result = read(data)
        outcome: Outcome = "read"
        if isinstance(result, Gaussians):
            size = sum(value.numel() * value.element_size() for value in result.tensors())
        del result
    except PointSplatError as error:
        outcome = "refused"
        if "\n" in str(error) or not str(error).strip():
            raise Wrong(f"an error that is not one line: {str(error)!r:.200}") from error
        error.__traceback__ = None
    except Wrong:
        raise
    except Exception as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames if "pointsplat_ns" in frame.filename]
        where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno}"
        text = str(error).splitlines()[0][:120] if str(error) else ""
        raise Wrong(f"{type(error).__name__} at {ours[-1] if ours else '?'} ({where}): {text}") from error
    taken = _peak() - before
    if taken > MEMORY + 2 * len(data) + 4 * size:
        raise Wrong(f"took {taken / 1e6:.0f} MB for {len(data)} bytes")
    return outcome


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
    except _TooLong as error:
        frames = traceback.extract_tb(error.__traceback__)
        ours = [f"{Path(frame.filename).name}:{frame.lineno}" for frame in frames if "pointsplat_ns" in frame.filename]
        raise Wrong(f"more than {SECONDS:g} s at {ours[-1] if ours else '?'}") from None
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _start_of_peak() -> int:
    """Begin to measure the peak of resident memory, and give what is resident now, bytes; 0 where it is not counted."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return 0
    return _status("VmRSS")


def _peak() -> int:
    return _status("VmHWM")


def _status(name: str) -> int:
    try:
        text = Path("/proc/self/status").read_text()
    except OSError:
        return 0
    return 1024 * int(text.partition(f"{name}:")[2].split(maxsplit=1)[0])
