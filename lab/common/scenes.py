"""Scenes to measure: which are for tuning, which judge, and a synthetic room of any size."""

from __future__ import annotations

from pathlib import Path

import torch

from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.runs import open_run, scene_name

TUNING = (
    "apt_bathroom",
    "bouquet",
    "pc_flowers",
    "pc_statue_massa",
    "plant_pilea",
    "kettle_pod",
    "pc_statue_angel",
    "pc_statue_narcissus",
    "pc_statue_trumpet",
    "kitchen",
    "fox",
    "final_3dgs",
    "vr_project",
    "room",
    "room5",
    "meeting",
    "drone_hall",
    "figure",
    "ray",
    "headquarter_garden",
)
"""Scenes that constants may be chosen on."""

JUDGED = (
    "apt_kitchen_balcony",
    "cake_fraisier",
    "mujoco_tabletop",
    "pc_playbot",
    "rock",
    "pc_statue_angel_kneeling",
    "pc_statue_angel_with_candlestick",
    "pc_statue_st_peter",
    "lounge",
    "diorama",
    "ethiopianHead",
    "dataset_perso",
    "lego_dense",
    "taebak",
    "office",
    "room35",
    "chair",
    "plant",
    "phone",
    "can",
)
"""Scenes that no constant is chosen on: they were named before the first measurement. See
docs/benchmarks.md."""


def group_of(scene: str) -> str:
    """ "tuning", "judged", or "" for any other scene."""
    return "tuning" if scene in TUNING else "judged" if scene in JUDGED else ""


def name_of(path: Path) -> str:
    """The name of a scene in tables: that of a run, or of a PLY's file."""
    return path.stem if path.suffix == ".ply" else scene_name(open_run(path))


def room(count: int, sh_degree: int = 3, seed: int = 0) -> Gaussians:
    """A synthetic scene: Gaussians on the six walls of a 6 x 3 x 6 room.

    Scales shrink as the count grows, so that every count covers the walls equally often.
    """
    g = torch.Generator().manual_seed(seed)
    half = torch.tensor([3.0, 1.5, 3.0])
    means = (2 * torch.rand(count, 3, generator=g) - 1) * half
    axis = torch.randint(0, 3, (count,), generator=g)
    side = 2.0 * torch.randint(0, 2, (count,), generator=g) - 1
    means[torch.arange(count), axis] = side * half[axis]
    quats = torch.randn(count, 4, generator=g)
    scales = 0.6 * (108 / count) ** 0.5 * torch.exp(0.7 * torch.randn(count, 3, generator=g))
    opacities = 0.05 + 0.9 * torch.rand(count, generator=g)
    sh = 0.1 * torch.randn(count, (sh_degree + 1) ** 2, 3, generator=g)
    return Gaussians(
        means, scales.log(), quats, opacities.logit()[:, None], sh[:, 0].clone(), sh[:, 1:].clone()
    )
