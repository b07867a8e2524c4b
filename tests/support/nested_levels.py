"""Nested levels of numbered Gaussians, which files of levels are compared with."""

import torch

import pointsplat_ns as ps
from making import normal_scene


def nested(counts: tuple[int, ...], degree: int) -> tuple[list[ps.Gaussians], list[torch.Tensor]]:
    """Levels of so many Gaussians, the finest first, and parents. Some opacities are 0 and 1; one
    Gaussian in nine of the finest level has no parent."""
    levels = [normal_scene(count, degree, seed=index) for index, count in enumerate(counts)]
    levels[0].opacities[::5] = torch.inf
    levels[0].opacities[1::5] = -torch.inf
    parents = [torch.arange(more) % fewer for more, fewer in zip(counts, counts[1:], strict=False)]
    if parents:
        parents[0][8::9] = -1
    return levels, parents


def rows_of(positions: torch.Tensor, scene: ps.Gaussians, most: float) -> list[int]:
    """The Gaussians of a scene at positions (K, 3)."""
    found = torch.cdist(positions.double(), scene.means.double()).min(dim=1)
    assert float(found.values.max()) <= most
    return found.indices.tolist()
