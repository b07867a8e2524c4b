"""Measures what a cluster costs beside processes of one machine.

    python -m lab.speed.cluster --scenes 8

Small scenes, cut from the example room, are compacted by ``--jobs 2`` and by a dask cluster of two
workers on this machine, in turn. CPU time is that of all processes: starting them, importing torch
in them, the scheduler. Results are compared.
"""

from __future__ import annotations

import contextlib
import os
import resource
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import tyro

import pointsplat_ns as ps

PROCESSES = 2


def main(scenes: int = 8, rounds: int = 2, every: int = 40) -> None:
    """Print CPU and wall seconds of each way.

    Args:
        scenes: number of scenes.
        rounds: how often each way is measured; the medians are printed.
        every: each scene has one of so many Gaussians of the example room.
    """
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    room = ps.example_room()
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "rooms"
        for number in range(scenes):
            ps.save(room[number::every], source / f"room{number}.ply")
        taken: dict[str, list[tuple[float, float]]] = {"--jobs 2": [], "--cluster": []}
        for number in range(rounds):
            outputs = []
            for way, figures in taken.items():
                output = Path(folder) / f"{way.strip('-').replace(' ', '')}{number}"
                outputs.append(output)
                before = time.perf_counter(), cpu_seconds()
                with contextlib.ExitStack() as stack:
                    options = {"jobs": PROCESSES}
                    if way == "--cluster":
                        options = {"cluster": stack.enter_context(local_cluster())}
                    ps.compact_folder(source, output, keep="10%", effort="instant", **options)
                after = time.perf_counter(), cpu_seconds()
                figures.append((after[0] - before[0], after[1] - before[1]))
            first, second = (contents(output) for output in outputs)
            assert first == second and len(first) == scenes
    for way, figures in taken.items():
        wall, cpu = (statistics.median(column) for column in zip(*figures, strict=True))
        each = f"{scenes} scenes of {len(room) // every:,} Gaussians"
        print(f"{way}: {cpu:.1f} CPU seconds, {wall:.1f} s, of {each}")


@contextlib.contextmanager
def local_cluster() -> Iterator[str]:
    """The address of a cluster of two workers on this machine."""
    from distributed import LocalCluster

    with LocalCluster(n_workers=PROCESSES, threads_per_worker=1, dashboard_address=None) as cluster:
        yield cluster.scheduler_address


def contents(folder: Path) -> list[bytes]:
    """The results in a folder, by name."""
    return [path.read_bytes() for path in sorted(folder.glob("*.ply"))]


def cpu_seconds() -> float:
    """CPU time of this process and of all that it has started, seconds."""
    own = resource.getrusage(resource.RUSAGE_SELF)
    ended = resource.getrusage(resource.RUSAGE_CHILDREN)
    running = psutil.Process().children(recursive=True)
    alive = sum(sum(process.cpu_times()[:2]) for process in running)
    return own.ru_utime + own.ru_stime + ended.ru_utime + ended.ru_stime + alive


if __name__ == "__main__":
    tyro.cli(main)
