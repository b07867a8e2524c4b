"""The machine of measurements: its name, and whether other programs keep it busy."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from pathlib import Path

import torch

from pointsplat_ns.system.cores import cores


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


def is_busy(others: float) -> bool:
    """Whether others leave too few cores for torch's threads. A quarter of a core does not change medians."""
    return others + torch.get_num_threads() > cores() + 0.25


def busy_note(others: Sequence[float | None]) -> str:
    """A line of text if other programs disturbed measurements, from the cores that they used during each, which are
    None where nothing was timed; else empty."""
    timed = [cores_used for cores_used in others if cores_used is not None]
    disturbed = [cores_used for cores_used in timed if is_busy(cores_used)]
    if not disturbed:
        return ""
    return (
        f"the machine was busy: while {len(disturbed)} of {len(timed)} points were timed, other programs took up "
        f"to {max(disturbed):.1f} of {cores()} cores; times are not to be trusted"
    )
