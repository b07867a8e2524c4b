"""The machine of measurements: its name, a lock for one measurement at a time, and whether it is busy."""

from __future__ import annotations

import platform
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import torch

from pointsplat_ns.system.claims import claim
from pointsplat_ns.system.cores import cores
from pointsplat_ns.system.progress import Progress


@dataclass(frozen=True)
class MeasuringLock:
    """The lock that measurements on this machine take in turn."""

    name: str = "pointsplat-measuring.lock"
    """Name of its file in the folder for temporary files, or a path."""
    pause: float = 0.2
    """Pause after a measurement in seconds, so that waiting processes can take the lock."""


LOCK = MeasuringLock()


def machine_text(device: torch.device) -> str:
    """Processor, number of threads, device and version of torch, as text."""
    threads = torch.get_num_threads()
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    return f"{_processor()}, {threads} thread{'s' if threads != 1 else ''}, {where}, torch {torch.__version__}"


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text("utf-8", "replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass  # another system than Linux
    return platform.processor() or platform.machine()


@contextmanager
def one_at_a_time(progress: Progress) -> Iterator[bool]:
    """Hold the lock of measurements on this machine while the context is open; wait for others that hold it, which
    is reported to ``progress``. Yields whether the lock was taken: its file may belong to another user."""
    path = Path(tempfile.gettempdir()) / LOCK.name
    with ExitStack() as stack:
        try:
            held = stack.enter_context(claim(path, mode=0o666))
            if not held:
                progress("waiting for another measurement on this machine", 0.0)
                stack.enter_context(claim(path, wait=True, mode=0o666))
        except OSError:
            yield False
            return
        yield True
    time.sleep(LOCK.pause)


def is_busy(others: float) -> bool:
    """Whether others leave too few cores for torch's threads. A quarter of a core does not change medians."""
    return others + torch.get_num_threads() > cores() + 0.25


def busy_note(others: Sequence[float]) -> str:
    """A line of text if other programs disturbed measurements, from the cores that they used during each; else
    empty."""
    disturbed = [cores_used for cores_used in others if is_busy(cores_used)]
    if not disturbed:
        return ""
    return (
        f"the machine was busy: while {len(disturbed)} of {len(others)} points were timed, other programs took up "
        f"to {max(disturbed):.1f} of {cores()} cores; times are not to be trusted"
    )
