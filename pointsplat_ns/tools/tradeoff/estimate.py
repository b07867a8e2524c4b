"""Estimates how long a measurement takes before it starts."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch

from pointsplat_ns.pipeline.repair_budget import PhotoBudget, RepairBudget
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.tensors import DOUBLES, FLOATS
from pointsplat_ns.tools.tradeoff.points import DENSE, EFFORTS, Setting


@dataclass(frozen=True)
class Costs:
    """Durations in units of :func:`unit_seconds`, which cancels the speed of the machine.

    ``python -m lab.speed.tradeoff_costs --scenes A B C`` finds them again, from merges and repairs
    of scenes of different size. Of two cuts of the example room and a bathroom, of 6,285 to 57,574
    Gaussians, they give the CPU time of each within 8 %.
    """

    merge: float = 61.0
    """Of a merge, whatever the scene: views are sampled and drawn."""
    merge_gaussian: float = 3.0e-3
    """Of a merge, per Gaussian of the dense scene."""
    step: float = 2.4
    """Of a step of a repair, with its share of the checks."""
    step_gaussian: float = 2.6e-4
    """Of a step, per Gaussian of the repaired scene."""


COSTS = Costs()


def unit_seconds() -> float:
    """Time to draw a fixed picture now, with the threads and the load of now: the best of five,
    seconds."""
    generator = torch.Generator().manual_seed(0)
    count = 20_000
    places = torch.rand((count, 3), generator=generator, **FLOATS) - 0.5
    scene = Gaussians(
        means=places,
        scales=torch.full((count, 3), math.log(0.02), **FLOATS),
        quats=torch.eye(4, **FLOATS)[:1].expand(count, 4).clone(),
        opacities=torch.zeros((count, 1), **FLOATS),
        features_dc=places.clone(),
        features_rest=torch.zeros((count, 0, 3), **FLOATS),
    )
    viewmat = torch.eye(4, **DOUBLES)
    viewmat[2, 3] = 1.5
    K = torch.tensor([[300.0, 0.0, 160.0], [0.0, 300.0, 120.0], [0.0, 0.0, 1.0]], **DOUBLES)
    view = Views(viewmat[None], K[None], 320, 240, torch.zeros(3, **FLOATS))[0]
    times = []
    for _ in range(5):
        start = time.perf_counter()
        with torch.no_grad():
            render(scene, view)
        times.append(time.perf_counter() - start)
    return min(times)


def making_units(setting: Setting, dense_count: int, costs: Costs = COSTS) -> float:
    """Estimated duration of making the scene of a setting, in units of :func:`unit_seconds`."""
    if setting.by == DENSE:
        return 0.0
    units = costs.merge + costs.merge_gaussian * dense_count
    if setting.repair == "none":
        return units
    kind = PhotoBudget if setting.repair == "photos" else RepairBudget
    steps = kind(EFFORTS[setting.repair]).for_count(setting.count).steps
    return units + steps * (costs.step + costs.step_gaussian * setting.count)


def measuring_seconds(
    settings: Sequence[Setting], dense_count: int, frames: int, frame_seconds: float, unit: float
) -> float:
    """Estimated duration of a measurement, seconds.

    Args:
        settings: all points.
        dense_count: number of Gaussians of the dense scene.
        frames: number of timed frames per point, each next to one of the dense scene.
        frame_seconds: time of one frame of the dense scene.
        unit: from :func:`unit_seconds`.
    """
    making = sum(making_units(setting, dense_count) for setting in settings) * unit
    drawn = sum(1 + setting.count / dense_count for setting in settings)
    return making + drawn * frames * frame_seconds
