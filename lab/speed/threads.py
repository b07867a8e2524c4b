"""What choosing the number of threads is worth beside other programs: seconds of a merge, and of a step of a repair and
of a ``splatfacto-cpu`` training, on all threads, on one, and on as many as are chosen.

    python -m lab.speed.threads --busy 0 1 2 --seconds 10

Each is measured in a process of its own, with so many others that only compute, in turns.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Literal

import pointsplat_ns as ps
from lab.common.printing import start
from pointsplat_ns.system.cores import cores

Work = Literal["merge", "repair", "training"]

TITLES: dict[Work, str] = {
    "merge": "merge to 10 %, s",
    "repair": "repair, s a step",
    "training": "training, s a step",
}

THREADS = ("all", "one", "chosen")

WARM_UP = 2
"""Steps of a training that are not timed."""


def merging(scene: Path | None, data: Path | None, seconds: float) -> float:
    """Seconds of a merge."""
    dense = ps.example_room() if scene is None else ps.load(scene)
    begin = time.perf_counter()
    ps.prune(dense, keep="10%")
    return time.perf_counter() - begin


def repairing(scene: Path | None, data: Path | None, seconds: float) -> float:
    """Seconds of a step of a repair."""
    from pointsplat_ns.compression.repair import repair
    from pointsplat_ns.compression.requests import RepairBudget
    from pointsplat_ns.looking.view_source import ViewSource

    dense = ps.example_room() if scene is None else ps.load(scene)
    small, views = ps.prune(dense, 0.1, "coverage"), ViewSource(dense)
    next(views.others())  # sampling views is not a part of a step
    done = repair(small, dense, views, RepairBudget(seconds=seconds))
    return done.seconds / done.steps


def training(scene: Path | None, data: Path | None, seconds: float) -> float:
    """Seconds of a step of a training."""
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as Location

    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

    assert data is not None
    with tempfile.TemporaryDirectory() as folder:
        config = splatfacto_cpu_config()
        config.machine.device_type, config.output_dir, config.vis = "cpu", Path(folder), "tensorboard"
        config.early_look = False  # type: ignore[attr-defined]
        config.pipeline.datamanager.dataparser = ReplicaDataParserConfig()  # type: ignore[attr-defined]
        config.pipeline.datamanager.data = config.data = data  # type: ignore[attr-defined]
        config.pipeline.model.num_downscales = 0  # type: ignore[attr-defined]
        config.set_timestamp()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        begin = time.perf_counter()
        for step in itertools.count():
            for where in (Location.BEFORE_TRAIN_ITERATION, Location.AFTER_TRAIN_ITERATION):
                for callback in trainer.callbacks:
                    callback.run_callback_at_location(step, where)
                if where is Location.BEFORE_TRAIN_ITERATION:
                    trainer.train_iteration(step)
            if step + 1 == WARM_UP:
                begin = time.perf_counter()
            elif step + 1 > WARM_UP and (spent := time.perf_counter() - begin) > seconds:
                return spent / (step + 1 - WARM_UP)
    raise AssertionError("the loop ends by returning")


MEASURES: dict[Work, Callable[[Path | None, Path | None, float], float]] = {
    "merge": merging,
    "repair": repairing,
    "training": training,
}


@contextmanager
def busy_machine(processes: int) -> Iterator[None]:
    """So many processes that only compute, while the context is open."""
    started = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(processes)]
    try:
        yield
    finally:
        for process in started:
            process.kill()
            process.wait()


def measured_apart(work: Work, threads: str, options: list[str]) -> float:
    """What a process of its own measures."""
    command = [sys.executable, "-m", "lab.speed.threads", "--measure", work, *options]
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    if threads != "chosen":
        environment["OMP_NUM_THREADS"] = str(cores() if threads == "all" else 1)
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)} failed: {done.stderr.strip()[-500:]}")
    return float(done.stdout.split()[-1])


def main(
    scene: Path | None = None,
    data: Path | None = None,
    works: tuple[Work, ...] = ("merge", "repair", "training"),
    busy: tuple[int, ...] = (0, 1, 2),
    seconds: float = 10.0,
    rounds: int = 3,
    measure: Work | None = None,
) -> None:
    """Print a row for each work and number of other processes.

    Args:
        scene: what is merged and repaired; by default the scene that ships.
        data: what is trained on, in the Replica layout; by default a room that is made.
        works: what is measured.
        busy: numbers of other processes.
        seconds: how long steps are taken.
        rounds: how often each is measured; the median is shown.
        measure: measure one in this process, and print its seconds.
    """
    if measure is not None:
        print(MEASURES[measure](scene, data, seconds))
        return
    with tempfile.TemporaryDirectory() as folder:
        if data is None and "training" in works:
            data = ps.write_room(Path(folder) / "room", 3, 20, progress=False)
        options = ["--seconds", str(seconds)]
        for name, path in (("--scene", scene), ("--data", data)):
            options += [name, str(path)] if path else []
        print(f"{cores()} cores; busy: other processes; {os.getloadavg()[0]:.1f} were running at the start\n")
        print("| | busy | all | one | chosen | all / chosen | one / chosen |\n|---|---|---|---|---|---|---|")
        for work, processes in itertools.product(works, busy):
            found: dict[str, list[float]] = {name: [] for name in THREADS}
            for _, name in itertools.product(range(rounds), THREADS):
                with busy_machine(processes):
                    found[name].append(measured_apart(work, name, options))
            every, one, chosen = (median(values) for values in found.values())
            cells = [
                *(f"{value:.3g}" for value in (every, one, chosen)),
                f"{every / chosen:.2f}",
                f"{one / chosen:.2f}",
            ]
            print(f"| {TITLES[work]} | {processes} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    start(main)
