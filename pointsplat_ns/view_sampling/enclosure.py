"""How far a place is enclosed by the scene: a room that is closed all round is not photographed
from beyond its walls.

The enclosure of a place is the share of directions in which there is content, near or far. From
outside of the convex hull of a scene, all of it lies within half of the directions. Within a room
that photos show all round, there is content in nearly all of them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import DOUBLES

CELLS_ACROSS = 4
"""Cells along each edge of a cube's six faces, equally wide in angle: 96 in all."""

OUTSIDE = 0.5
"""Largest enclosure of a place outside of a convex scene."""


def enclosures(points: Tensor, eyes: Tensor) -> Tensor:
    """Share of the directions from each eye in which there is a point.

    Args:
        points: (n, 3), n at least 1.
        eyes: (V, 3), in the same unit.

    Returns:
        (V,) float64 in (0, 1], in steps of a 96th.

    Example:
        >>> import torch
        >>> corners = torch.cartesian_prod(*[torch.linspace(-1, 1, 9)] * 3)
        >>> enclosures(corners, torch.tensor([[0.1, 0.0, 0.0], [9.0, 0.0, 0.0]])).round(decimals=2)
        tensor([1.0000, 0.0400], dtype=torch.float64)
    """
    cells = 6 * CELLS_ACROSS**2
    points = points.double()
    # slopes at the borders of cells that are equally wide in angle
    borders = torch.tensor([-0.25, 0.0, 0.25], **DOUBLES).mul_(math.pi / 2).tan()
    found = []
    for some in eyes.double().split(16):
        offsets = points - some[:, None]
        longest, axis = offsets.abs().max(dim=2)
        face = 2 * axis + (offsets.gather(2, axis[..., None])[..., 0] > 0).long()
        others = (axis[..., None] + axis.new_tensor([1, 2])) % 3
        slopes = (
            offsets.gather(2, others)
            / longest.clamp_min(torch.finfo(torch.float64).tiny)[..., None]
        )
        across = torch.bucketize(slopes, borders, right=True)
        cell = (face * CELLS_ACROSS + across[..., 0]) * CELLS_ACROSS + across[..., 1]
        marks = torch.zeros(len(some), cells, **DOUBLES).scatter_(1, cell, 1.0)
        found.append(marks.mean(1))
    return torch.cat(found)


def outside_of_a_room(enclosure: Tensor, likelihoods: Tensor, least: float) -> Tensor:
    """Which candidates stand beyond the walls of a closed room, if the scene is one: if the mean
    enclosure of photos is at least ``least``.

    Args:
        enclosure: (V,) of candidates for views.
        likelihoods: (V,) their log-likelihoods, finite, up to a constant.
        least: mean enclosure of the photos of a room.

    Returns:
        (V,) bool; all False if the scene is no room.
    """
    mean = float((likelihoods.softmax(dim=0) * enclosure).sum())
    return (enclosure <= OUTSIDE) & (mean >= least)
