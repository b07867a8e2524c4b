"""Finds the costs by which ``pointsplat tradeoff`` estimates its duration.

    python -m lab.speed.tradeoff_costs --scenes small.ply middle.ply large.ply

Each scene is merged to a tenth, and also repaired, as ``tradeoff`` does. Durations are CPU
time, on one thread, so that other programs change them little. The costs have the least squared
error relative to the durations, and none is negative.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from unittest import mock

import numpy as np
import tyro
from scipy.optimize import nnls

from pointsplat_ns.pipeline.options import NO_POSES, ViewOptions
from pointsplat_ns.system.progress import silent
from pointsplat_ns.system.threads import one_thread
from pointsplat_ns.tools.tradeoff import estimate
from pointsplat_ns.tools.tradeoff.estimate import Costs, making_units, unit_seconds
from pointsplat_ns.tools.tradeoff.measured_scene import make, subject_at
from pointsplat_ns.tools.tradeoff.points import Repair, Setting

KINDS: tuple[Repair, ...] = ("none", "quick")


def main(scenes: tuple[Path, ...]) -> None:
    """Print the costs, and measured beside estimated durations.

    Args:
        scenes: files of scenes without poses; three or more, of different size.
    """
    rows, durations, names = [], [], []
    with one_thread(), mock.patch.object(estimate.time, "perf_counter", time.process_time):
        for scene in scenes:
            subject = subject_at(scene, ViewOptions(poses=NO_POSES), None, silent, False)
            count = len(subject.dense)
            for repair in KINDS:
                setting = Setting(count // 10, repair)
                unit = unit_seconds()
                seconds = cpu_seconds(functools.partial(make, subject, setting, silent))
                rows.append(terms(setting, count))
                durations.append(seconds / unit)
                names.append((scene.stem, setting, seconds, unit))
                print(f"{scene.stem}: {count:,} to {setting.count:,}, {repair}: {seconds:.1f} s")
    relative = np.array(rows) / np.array(durations)[:, None]
    found = Costs(*nnls(relative, np.ones(len(rows)))[0].tolist())
    print(found)
    for (name, setting, seconds, unit), row in zip(names, rows, strict=True):
        expected = float(np.dot(row, [getattr(found, field.name) for field in fields(Costs)]))
        print(f"{name}, {setting}: {seconds:.1f} s, estimated {expected * unit:.1f} s")


def cpu_seconds(work: Callable[[], object]) -> float:
    """CPU time of this process during the work, seconds."""
    start = time.process_time()
    work()
    return time.process_time() - start


def terms(setting: Setting, count: int) -> list[float]:
    """What each of the :class:`Costs` is multiplied by."""
    ones = [Costs(*np.eye(len(fields(Costs)))[place]) for place in range(len(fields(Costs)))]
    return [making_units(setting, count, one) for one in ones]


if __name__ == "__main__":
    tyro.cli(main)
