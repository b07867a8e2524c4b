"""Scenes of flat Gaussians that stand upright, and turns of the world."""

import math

import torch
from scipy.spatial.transform import Rotation

from making import splats
from pointsplat_ns.scene.gaussians import Gaussians

TURNS = [Rotation.identity(), *(Rotation.random(random_state=seed) for seed in range(4))]


def plates(
    *faces: tuple[tuple[float, float, float], tuple[float, float, float]], density: int = 40
) -> Gaussians:
    """Flat Gaussians on rectangles, each given by its middle and its half-sizes, one of which is
    0."""
    generator = torch.Generator().manual_seed(0)
    means = []
    scales = []
    for middle, half in faces:
        count = max(8, int(density * math.prod(2 * side for side in half if side)))
        share = 2 * torch.rand(count, 3, generator=generator) - 1
        means.append(torch.tensor(middle) + share * torch.tensor(half))
        scales.append(
            torch.tensor([0.1 if side else 0.005 for side in half]).log().expand(count, 3)
        )
    return splats(torch.cat(means), torch.cat(scales), 4.0)


def room() -> Gaussians:
    """4 x 3 x 2.4 units, with a table at an angle to no wall and a bed."""
    walls = [((x, 0, 0), (0, 1.5, 1.2)) for x in (-2, 2)] + [
        ((0, y, 0), (2, 0, 1.2)) for y in (-1.5, 1.5)
    ]
    level = [((0, 0, z), (2, 1.5, 0)) for z in (-1.2, 1.2)]
    return plates(
        *walls, *level, ((1, 0.6, -0.5), (0.6, 0.4, 0)), ((-1.2, -0.6, -0.8), (0.7, 0.8, 0))
    )


def tower() -> Gaussians:
    """A post of 0.6 x 0.6 x 3 units on the ground, which is 4 x 4."""
    sides = [((x, 0, 1.5), (0, 0.3, 1.5)) for x in (-0.3, 0.3)] + [
        ((0, y, 1.5), (0.3, 0, 1.5)) for y in (-0.3, 0.3)
    ]
    return plates(*sides, ((0, 0, 0), (2, 2, 0)), ((0, 0, 3), (0.3, 0.3, 0)))


def turned(scene: Gaussians, turn: Rotation) -> Gaussians:
    """The scene after a rotation of the world, for Gaussians that are not turned themselves."""
    quats = torch.from_numpy(turn.as_quat())[[3, 0, 1, 2]].to(scene.dtype)
    means = scene.means.double() @ torch.from_numpy(turn.as_matrix()).T
    return scene.replace(means=means.to(scene.dtype), quats=quats.repeat(len(scene), 1))
