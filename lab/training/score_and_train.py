"""Prunes a run by a score and trains the rest on its photos: LightGaussian's and PUP-3DGS's recipe.

python -m lab.training.score_and_train lightgaussian 120 RUN --keep 5000 -o small.ply
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

import pointsplat_ns as ps
from lab.common.printing import start
from pointsplat_ns.nerfstudio_plugin.dataset_views import run_photos
from pointsplat_ns.pipeline.options import PruneOptions, ViewOptions
from pointsplat_ns.pipeline.photo_repair import photo_repair
from pointsplat_ns.pipeline.prune_scene import prune_scene
from pointsplat_ns.pipeline.repair_budget import PhotoBudget
from pointsplat_ns.pipeline.subject import read_subject


@dataclass(frozen=True)
class CpuBudget(PhotoBudget):
    """Training for a number of CPU seconds."""

    cpu_seconds: float = 0.0
    started: float = 0.0

    @property
    def empty(self) -> bool:
        """Whether there are none."""
        return self.cpu_seconds <= 0

    def share_done(self, steps: int, seconds: float) -> float:
        """Used share of the CPU seconds."""
        return (time.process_time() - self.started) / self.cpu_seconds


def main(
    by: tyro.conf.Positional[Literal["lightgaussian", "pup"]],
    seconds: tyro.conf.Positional[float],
    run: tyro.conf.Positional[Path],
    keep: int,
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
) -> None:
    """Prune a run by a score, and train the rest on its photos as ``compact --photos`` does.

    Args:
        by: the score.
        seconds: CPU seconds of the training.
        run: the run.
        keep: number of Gaussians.
        output: the PLY to write.
    """
    subject = read_subject(run, ViewOptions())
    dense = subject.dense
    views = subject.views()
    pruned = prune_scene(dense, PruneOptions(keep, by), views).scene
    budget = CpuBudget(cpu_seconds=seconds, started=time.process_time())
    trained = photo_repair(pruned, dense, run_photos(run), views, budget)
    print(
        f"{trained.steps} steps: {trained.before:.2f} -> {trained.after:.2f} dB in "
        f"{trained.compared} photos"
    )
    ps.save(trained.scene, output, overwrite=True)


if __name__ == "__main__":
    start(main)
