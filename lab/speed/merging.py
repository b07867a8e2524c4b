"""CPU time of the parts of merging, by compiled kernels and in torch, and of the whole.

    python -m lab.speed.merging                              # synthetic room of 100,000
    python -m lab.speed.merging scenes/bouquet.ply --json merging.json

Each part is timed on the state before the first round, on one thread, in CPU seconds, kernels and torch in turns; each
costs as much again in the rounds that follow, in proportion to what remains. Compare figures of one run, by their
ratios.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import pandas as pd
import torch
import tyro

from lab.common.printing import console, number, start, table
from lab.common.results import write_json
from lab.common.scenes import KEEP, room
from lab.common.timing import seconds_of, timed, use_cpu_time
from lab.common.ways import count_of
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.neighbours import other_neighbours
from pointsplat_ns.io import read_scene
from pointsplat_ns.looking.sampling import Sampler
from pointsplat_ns.merging import MERGING, merge
from pointsplat_ns.merging.matching import cheapest_pairs
from pointsplat_ns.merging.pair_cost import pair_costs
from pointsplat_ns.merging.regrouping import Members, best_groups, group_moments
from pointsplat_ns.merging.state import Participants, initial_state
from pointsplat_ns.merging.visibility import sampled_viewpoints
from pointsplat_ns.rasterizer import pixels_of

Part = Callable[[bool], object]


def parts_of(scene: Gaussians) -> dict[str, Part]:
    """The parts of merging, by name, as functions of whether they use compiled kernels."""
    participants = Participants.of(scene, scene.usable().nonzero()[:, 0])
    state = initial_state(participants, torch.ones(len(participants)))
    near = other_neighbours(state.means.double(), MERGING.neighbours)
    costs = pair_costs(state, near)
    most = int(MERGING.round_share * len(state))
    members, count = Members(scene, participants.members), count_of(KEEP, len(state))
    group = torch.arange(len(state)) * count // len(state)  # neighbours along the curve
    groups = group_moments(members, group, count)
    parts: dict[str, Part] = {
        "costs of pairs": lambda compiled: pair_costs(state, near, compiled=compiled),
        "matching": lambda compiled: cheapest_pairs(near, costs.clone(), most, compiled=compiled),
        "choice of groups": lambda compiled: best_groups(members, group, groups, compiled=compiled),
    }
    whole = participants.in_units(scene)
    if viewpoints := sampled_viewpoints(Sampler(whole), MERGING):
        view = viewpoints.views.resized(112)[0]
        parts["visible pixels, a view"] = lambda compiled: pixels_of(whole, view, compiled)
    return parts


def measured(scene: Gaussians, repeats: int, budget: float) -> pd.DataFrame:
    """Seconds of each part, by kernels and in torch."""
    functions = {}
    for name, part in parts_of(scene).items():
        for way, compiled in (("kernels", True), ("torch", False)):
            functions[name, way] = lambda key=(name, way), part=part, on=compiled: {key: seconds_of(lambda: part(on))}
    return pd.Series(timed(functions, repeats, budget)).unstack(sort=False)


@torch.no_grad()
def main(
    scene: tyro.conf.Positional[Path | None] = None,
    gaussians: int = 100_000,
    repeats: int = 3,
    budget: float = 120.0,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Print what the parts of merging take.

    Args:
        scene: a PLY; by default a synthetic room.
        gaussians: size of the room.
        repeats: rounds of measurements, of which medians are taken.
        budget: seconds after which no further round begins.
        json_path: write the figures there.
    """
    use_cpu_time()
    torch.set_num_threads(1)
    dense = room(gaussians) if scene is None else read_scene(scene)
    seconds, n = measured(dense, repeats, budget), len(dense)
    whole = seconds_of(lambda: merge(dense, count_of(KEEP, n)))
    figures = {"gaussians": n, "sh_degree": dense.sh_degree, "parts": seconds.to_dict("index"), "whole": whole}
    write_json(json_path, figures)
    lines = [
        (name, *map(number(2, 1e6 / n), (row.kernels, row.torch)), number(1)(row.torch / row.kernels))
        for name, row in seconds.iterrows()
    ]
    heads = ("part", "kernels, us a Gaussian", "torch, us a Gaussian", "ratio")
    console().print(table(f"merging {n:,} Gaussians, the first round, CPU time of one thread", heads, lines))
    print(f"whole, to {KEEP:.0%}: {whole:.1f} CPU s")


if __name__ == "__main__":
    start(main)
