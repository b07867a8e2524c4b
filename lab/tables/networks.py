"""Trains all networks of the paper's Tables 1, 3 and 4, each for its row and share of the
Gaussians.

    python -m lab.tables.networks outputs -o networks --held-out room35 phone
    python -m lab.tables RUN_OF_ROOM35 RUN_OF_PHONE -o tables --refiners networks

The same command resumes: finished networks are left alone, an interrupted one resumes from its last
step.
"""

from __future__ import annotations

import shutil
import signal
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from lab.common.printing import start
from lab.common.running import folder_of_run, run, train_refiner_command
from lab.tables.ways import PROTOCOL, WAYS, Way
from pointsplat_ns.errors import PointSplatError, SceneError
from pointsplat_ns.scene.runs import METHOD_NAMES, RUN_FILES, open_run


@dataclass(frozen=True)
class Training:
    """How a network is trained, but for what its row needs."""

    steps: int
    method: str = METHOD_NAMES.refiner
    options: dict[str, Any] = field(default_factory=dict)


TRAININGS = {
    "paper": Training(10_000, f"{METHOD_NAMES.refiner}-paper"),
    "small": Training(
        690,
        options={
            "pipeline.datamanager.supervision": "dense",
            "pipeline.model.size": "small",
            "pipeline.model.pixel-loss": "rmse",
            "pipeline.model.lpips-weight": 0.05,
            "rate-factor": 12.0,
        },
    ),
}
"""Trainings by name. "paper" needs a GPU; "small" is for CPUs, and not the published one."""


@dataclass(frozen=True)
class Job:
    """One network: the row that needs it, its share of the Gaussians, and a seed."""

    way: Way
    share: float
    seed: int = 0

    @property
    def name(self) -> str:
        """The name of its run.

        Example:
            >>> Job(WAYS.pointsplat, 0.1, 2).name
            'pointsplat-10-seed2'
        """
        return f"{self.way.name}-{100 * self.share:g}" + (f"-seed{self.seed}" if self.seed else "")


def jobs(seeds: int = 1, own: bool = False) -> list[Job]:
    """All networks of a protocol, *unseen* or *own photos*: sixteen, and those of Table 4 again
    with each further seed."""

    def wanted(way: Way) -> bool:
        return way.network is not None and way.own == own

    found = [Job(way, share) for way, share in WAYS.cells(PROTOCOL.shares) if wanted(way)]
    ablated = [way for way in WAYS.table_4 if wanted(way)]
    return found + [
        Job(way, PROTOCOL.ablation_share, seed) for seed in range(1, seeds) for way in ablated
    ]


def main(
    scenes: tyro.conf.Positional[Path],
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    held_out: tuple[str, ...] = (),
    own: bool = False,
    training: Literal["small", "paper"] = "small",
    size: Literal["tiny", "small", "full"] | None = None,
    steps: int | None = None,
    seconds: float | None = None,
    in_all: bool = False,
    seeds: int = 1,
    shard: str = "1/1",
) -> None:
    """Train all networks of Tables 1, 3 and 4 that OUTPUT lacks.

    Args:
        scenes: folder above trained runs; with --own, of the scenes of the tables and no others.
        output: folder for the networks, for ``python -m lab.tables --refiners``.
        held_out: names of scenes that no network is trained on: those of the tables.
        own: train the networks of the rows "own photos", on the training photos of the scenes.
        training: "paper", as published, which needs a GPU; or "small", for CPUs.
        size: size of the networks, in place of the training's.
        steps: steps of each network, in place of the training's.
        seconds: time of each network, in place of steps.
        in_all: the seconds are for all networks together.
        seeds: number of trainings of each network of Table 4.
        shard: I/N trains every N-th network from the I-th on, so that N machines share the work;
            then bring the folders together.
    """
    part, slash, parts = shard.partition("/")
    if not (slash and part.isdecimal() and parts.isdecimal() and 1 <= int(part) <= int(parts)):
        raise PointSplatError(f"--shard {shard}: expected I/N such as 1/3, with I from 1 to N")
    every = jobs(seeds, own)
    if seconds is not None and in_all:
        seconds /= len(every)
    chosen = TRAININGS[training]
    own = every[int(part) - 1 :: int(parts)]
    options = chosen.options | ({} if size is None else {"pipeline.model.size": size})
    for number, job in enumerate(own, 1):
        folder = folder_of_run(output, job.name, chosen.method, "run")
        if (folder / RUN_FILES.refiner).is_file():  # written at the end of a training
            continue
        assert job.way.network is not None
        needs = (
            options
            | job.way.network.options(job.share, own)
            | {"pipeline.datamanager.seed": job.seed}
        )
        left = steps or chosen.steps
        try:
            left = max(1, left - open_run(folder, need_data=False).step - 1)
            needs |= {"load-dir": folder / "nerfstudio_models"}
        except SceneError:  # no checkpoint yet
            shutil.rmtree(folder, ignore_errors=True)
        needs |= {} if seconds is None else {"seconds": seconds}
        print(f"{number} of {len(own)}: {job.name}", flush=True)
        command = train_refiner_command(
            scenes, output, job.name, left, "run", held_out, needs, chosen.method
        )
        run(command, output / "logs" / f"{job.name}.txt")
    print(f"{output}: {len(own)} networks of {len(every)}")


if __name__ == "__main__":
    signal.signal(
        signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM)
    )  # so that the training is ended as well
    start(main)
