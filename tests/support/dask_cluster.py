"""A dask cluster on this machine: a scheduler and two workers, each a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from making import quick_start
from pointsplat_ns.system import cluster

SUPPORT = Path(__file__).parent


@contextmanager
def scheduler_in(folder: Path) -> Iterator[tuple[Path, subprocess.Popen]]:
    """A scheduler: its scheduler file, and its process. Work that killed two workers is lost."""
    file = folder / "scheduler.json"
    with _program("scheduler", folder, "--port", "0", "--host", "127.0.0.1") as process:
        wait_until(file.is_file, process)
        yield file, process


@contextmanager
def workers_in(folder: Path, count: int = 2) -> Iterator[None]:
    """Workers with one thread each, started again when they die, in another current folder than
    the tests."""
    with _program("worker", folder, "--nworkers", count, "--nthreads", 1):
        yield


@contextmanager
def _program(kind: str, folder: Path, *words: object) -> Iterator[subprocess.Popen]:
    path = os.pathsep.join([str(Path.cwd()), str(SUPPORT), quick_start()["PYTHONPATH"]])
    environment = {
        **os.environ,
        "PYTHONPATH": path,
        "OMP_NUM_THREADS": "1",
        "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
    }
    words = (
        "--scheduler-file",
        folder / "scheduler.json",
        "--dashboard-address",
        "127.0.0.1:0",
        *words,
    )
    with (folder / f"{kind}.log").open("w") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.dask_{kind}", *map(str, words)],
            cwd=folder,
            env=environment,
            stdout=log,
            stderr=log,
        )
    try:
        yield process
    finally:
        process.terminate()
        process.wait(1800)


def at_work() -> bool:
    """Whether this worker does a piece of work, perhaps of a command that no longer waits for
    it."""
    return cluster._one_at_a_time.locked()


def wait_until(
    happened: Callable[[], object], process: subprocess.Popen | None = None, seconds: float = 1800
) -> None:
    """Wait for something that a process does. Raises AssertionError if it ends before, or takes
    too long."""
    deadline = time.monotonic() + seconds
    while not happened():
        assert process is None or process.poll() is None, "it has ended"
        assert time.monotonic() < deadline, "it takes too long"
        time.sleep(0.05)
