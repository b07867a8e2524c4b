"""What choosing the number of threads is worth beside other programs: seconds of a merge, and of a step of a repair and
of a ``splatfacto-cpu`` training, on all threads, on one, and on as many as are chosen.

    python benchmarks/threads.py --busy 0 1 2 --seconds 10

Each is measured in a process of its own, with so many others that only compute, in turns.
"""

from __future__ import annotations

import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Annotated, Literal

import tyro

import pointsplat_ns as ps
from pointsplat_ns.system.cores import cores

Work = Literal["merge", "repair", "training"]

TITLES: dict[Work, str] = {
    "merge": "merge to 10 %, s",
    "repair": "repair, s a step",
    "training": "training, s a step",
}

WARM_UP = 2
"""Steps of a training that are not timed."""


@dataclass
class Options:
    """What is measured."""

    scene: Path | None = None
    """What is merged and repaired; by default the scene that ships."""
    data: Path | None = None
    """What is trained on, in the Replica layout; by default a room that is made."""
    works: tuple[Work, ...] = ("merge", "repair", "training")
    busy: tuple[int, ...] = (0, 1, 2)
    """Numbers of other processes."""
    seconds: float = 10.0
    """How long steps are taken."""
    rounds: int = 3
    """How often each is measured; the median is shown."""
    measure: Annotated[Work | None, tyro.conf.arg(help="measure one in this process, and print its seconds")] = None


def merging(options: Options) -> float:
    """Seconds of a merge."""
    scene = ps.example_room() if options.scene is None else ps.load(options.scene)
    start = time.perf_counter()
    ps.prune(scene, keep="10%")
    return time.perf_counter() - start


def repairing(options: Options) -> float:
    """Seconds of a step of a repair."""
    from pointsplat_ns.compression.repair import RepairBudget, repair
    from pointsplat_ns.looking.view_source import ViewSource
    from pointsplat_ns.pruning import prune

    scene = ps.example_room() if options.scene is None else ps.load(options.scene)
    small, views = prune(scene, 0.1, "coverage"), ViewSource(scene)
    next(views.others())  # sampling views is not a part of a step
    done = repair(small, scene, views, RepairBudget(seconds=options.seconds))
    return done.seconds / done.steps


def training(options: Options) -> float:
    """Seconds of a step of a training."""
    from nerfstudio.engine.callbacks import TrainingCallbackLocation as Location

    from pointsplat_ns.nerfstudio_plugin.replica.dataparser import ReplicaDataParserConfig
    from pointsplat_ns.nerfstudio_plugin.splatfacto_cpu.config import splatfacto_cpu_config

    assert options.data is not None
    with tempfile.TemporaryDirectory() as folder:
        config = splatfacto_cpu_config()
        config.machine.device_type, config.output_dir, config.vis = "cpu", Path(folder), "tensorboard"
        config.early_look = False  # type: ignore[attr-defined]
        config.pipeline.datamanager.dataparser = ReplicaDataParserConfig()  # type: ignore[attr-defined]
        config.pipeline.datamanager.data = config.data = options.data  # type: ignore[attr-defined]
        config.pipeline.model.num_downscales = 0  # type: ignore[attr-defined]
        config.set_timestamp()
        trainer = config.setup(local_rank=0, world_size=1)
        trainer.setup()
        start = time.perf_counter()
        for step in itertools.count():
            for where in (Location.BEFORE_TRAIN_ITERATION, Location.AFTER_TRAIN_ITERATION):
                for callback in trainer.callbacks:
                    callback.run_callback_at_location(step, where)
                if where is Location.BEFORE_TRAIN_ITERATION:
                    trainer.train_iteration(step)
            if step + 1 == WARM_UP:
                start = time.perf_counter()
            elif step + 1 > WARM_UP and (seconds := time.perf_counter() - start) > options.seconds:
                return seconds / (step + 1 - WARM_UP)
    raise AssertionError("the loop ends by returning")


MEASURES = {"merge": merging, "repair": repairing, "training": training}


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


@dataclass
class Row:
    """Seconds of a work by the number of threads: "all", "one" or "chosen"."""

    work: Work
    busy: int
    seconds: dict[str, list[float]] = field(default_factory=lambda: {"all": [], "one": [], "chosen": []})

    def text(self) -> str:
        values = {name: median(seconds) for name, seconds in self.seconds.items()}
        ratios = (values["all"] / values["chosen"], values["one"] / values["chosen"])
        cells = [
            TITLES[self.work],
            self.busy,
            *(f"{value:.3g}" for value in values.values()),
            *map("{:.2f}".format, ratios),
        ]
        return f"| {' | '.join(map(str, cells))} |"


def measured_apart(work: Work, threads: str, options: Options) -> float:
    """What a process of its own measures."""
    command = [sys.executable, __file__, "--measure", work, "--seconds", str(options.seconds)]
    command += ["--scene", str(options.scene)] if options.scene else []
    command += ["--data", str(options.data)] if options.data else []
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    if threads != "chosen":
        environment["OMP_NUM_THREADS"] = str(cores() if threads == "all" else 1)
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode != 0:
        raise SystemExit(f"{' '.join(command)} failed: {done.stderr.strip()[-500:]}")
    return float(done.stdout.split()[-1])


def main(options: Options) -> None:
    """Measure, and print a row as soon as it is complete."""
    if options.measure is not None:
        print(MEASURES[options.measure](options))
        return
    with tempfile.TemporaryDirectory() as folder:
        if options.data is None and "training" in options.works:
            options.data = ps.write_room(Path(folder) / "room", 3, 20, progress=False)
        print(f"{cores()} cores; busy: other processes; {os.getloadavg()[0]:.1f} were running at the start\n")
        print("| | busy | all | one | chosen | all / chosen | one / chosen |\n|---|---|---|---|---|---|---|")
        for work, busy in itertools.product(options.works, options.busy):
            row = Row(work, busy)
            for _, (name, seconds) in itertools.product(range(options.rounds), row.seconds.items()):
                with busy_machine(busy):
                    seconds.append(measured_apart(work, name, options))
            print(row.text(), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options))
