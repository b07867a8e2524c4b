"""What other programs cost: a step of a repair beside some that never pause, by the number of threads.

    python -m lab.speed.busy --programs 1 2

The number that is chosen is compared with one thread and with all. Steps of the three are taken in turn.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from statistics import median

import torch

import pointsplat_ns as ps
from lab.common.printing import console, start, table
from pointsplat_ns.compression.optimiser import gradients_of
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.system.cores import OtherPrograms, cores
from pointsplat_ns.system.threads import THREADS_VARIABLE, fixed_threads, suitable_threads


@contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Run so many programs that never pause while the context is open."""
    running = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for program in running:
            program.kill()
            program.wait()


def main(programs: Sequence[int] = (0, 1, 2), rounds: int = 10, steps: int = 5) -> None:
    """Print a table: medians over rounds of wall and CPU milliseconds of a step.

    Args:
        programs: numbers of programs that never pause, one after the other.
        rounds: number of times that each is measured.
        steps: number of steps in each.
    """
    if THREADS_VARIABLE in os.environ:
        raise PointSplatError(f"{THREADS_VARIABLE} is set, so no number of threads is chosen; expected it not to be")
    room = ps.example_room()
    view = ps.sample_views(room, 1)[0]
    target, most = ps.render(room, view), cores()
    torch.set_num_threads(most)

    def step(threads: int | None) -> tuple[float, float, float]:
        """Milliseconds of the clock and of this process, and the number of threads."""
        begun, own = time.perf_counter(), time.process_time()
        for _ in range(steps):
            with fixed_threads(threads), suitable_threads(room.device):
                used = torch.get_num_threads()
                gradients_of(room, view, target)
        return 1e3 * (time.perf_counter() - begun) / steps, 1e3 * (time.process_time() - own) / steps, used

    rows = []
    ways = {"chosen": None, "one": 1, "all": most}
    for count in programs:
        with busy_programs(count):
            others = OtherPrograms()
            step(None)
            found = [{name: step(threads) for name, threads in ways.items()} for _ in range(rounds)]
            taken = others.cores()
        for name in ways:
            wall, cpu, used = (median(each[name][column] for each in found) for column in range(3))
            rows.append((count, f"{taken:.1f}", name, f"{used:.0f}", f"{wall:.0f}", f"{cpu:.0f}"))
    heads = ("programs", "cores that others took", "threads", "number", "wall ms", "CPU ms")
    console().print(table(f"a step of a repair, {most} cores", heads, rows, left=("threads",)))


if __name__ == "__main__":
    start(main)
