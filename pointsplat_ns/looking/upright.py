"""Estimates which way is up in a scene that comes without cameras.

Objects that stand upright have surfaces that are level or vertical (floors, tables, walls, legs), whichever way
furniture is turned; and level surfaces share their heights (a floor, a table top). The Gaussians show both: the
shortest axis of a flat Gaussian is the normal of its surface. SH, where photos left traces in them, show more: few
photos are taken straight down, and fewer straight up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.geometry.transforms import AXES, axis_along, direction_of
from pointsplat_ns.looking.settings import LOOKING
from pointsplat_ns.looking.surface import Surface
from pointsplat_ns.looking.traces import PhotoEvidence
from pointsplat_ns.system.tensors import DOUBLES

CONTENT_RADIUS = 6.0
"""Distance from the centre of the content within which points belong to it, units."""


@dataclass(frozen=True, eq=False)
class Up:
    """The direction that is up in a scene."""

    direction: Tensor
    """(3,) float64, of length 1."""
    sure: bool = True
    """Whether it was named or declared, or clearly more of the scene is seen from above than from below."""

    def __str__(self) -> str:
        """The name of the axis, or the direction.

        Example:
            >>> str(Up(torch.tensor([0.0, -1.0, 0.0]), sure=False))
            '-y (a guess)'
        """
        text = axis_along(self.direction) or " ".join(f"{value:.2f}" for value in self.direction.tolist())
        return text if self.sure else f"{text} (a guess)"


def axis_named(text: str) -> Tensor:
    """A world axis (3,), float64, by its name, such as "z" or "-y".

    Raises:
        PointSplatError: if there is no such axis.
    """
    name = text.strip().lower().removeprefix("+")
    if name not in AXES:
        raise PointSplatError(f"up is {text!r}; expected {', '.join(AXES[:-1])} or {AXES[-1]}")
    return direction_of(name)


def up_named(text: str | None) -> Up | None:
    """The up direction of an option, which names an axis; None if it is not given.

    Raises:
        PointSplatError: if there is no such axis.
    """
    return None if text is None else Up(axis_named(text))


def known_up(named: Up | None, scene: Gaussians) -> Up | None:
    """The up direction that needs no estimate: the named one, else the one that the scene's file declares."""
    return named or up_named(scene.up)


def level_directions(up: Tensor, turn: Tensor) -> Tensor:
    """Directions (n, 3) at a right angle to ``up`` (3,), at angles (n,) around it, radians."""
    right = _across(up)
    return turn.cos()[:, None] * right + turn.sin()[:, None] * torch.linalg.cross(up, right)


def _across(axes: Tensor) -> Tensor:
    """A direction at a right angle to each axis (..., 3)."""
    right = torch.linalg.cross(axes, torch.eye(3, dtype=axes.dtype, device="cpu")[axes.abs().argmin(-1)])
    return right / right.norm(dim=-1, keepdim=True)


def upright_axis(surface: Surface, evidence: PhotoEvidence | None = None) -> Tensor:
    """The axis (3,) along which a scene stands, float64, of length 1 and of either sign.

    It is an axis of the world if that fits about as well as the best direction, and y if that fits about as well as the
    best of the three.

    Args:
        surface: points of the scene.
        evidence: Gaussians that tell from which directions photos were taken, if they do.
    """
    content = _content(surface)

    def scores_of(axes: Tensor) -> Tensor:
        scores = uprightness(axes, content)
        if evidence is None:
            return scores
        photographed_along = 0.5 * (evidence.towards(axes) + evidence.towards(-axes))
        return scores + LOOKING.photo_direction_weight * (1 - photographed_along)

    directions, refined = 400, 8  # about 7 degrees apart, and how many of the best are refined
    index = torch.arange(directions, **DOUBLES) + 0.5
    height = 1 - index / directions  # Fibonacci's spiral
    turn = index * math.pi * (3 - math.sqrt(5))
    ring = (1 - height.square()).sqrt()
    around = torch.stack([ring * turn.cos(), ring * turn.sin(), height], dim=1)
    scores = scores_of(around)
    found = around[scores.topk(refined).indices]
    for degrees in (4.0, 2.0, 1.0, 0.5):
        found = torch.cat([found, _nearby(found, math.radians(degrees))])
        scores = scores_of(found)
        found = found[scores.topk(refined).indices]
    of_world, of_y = LOOKING.usual_axis_factors if evidence is None else (1.05, 1.0)
    world = torch.eye(3, **DOUBLES)
    world_scores = world.new_tensor([of_world, of_world * of_y, of_world]) * scores_of(world)
    return world[world_scores.argmax()] if bool(world_scores.max() >= scores.max()) else found[0]


def pointing_up(surface: Surface, axis: Tensor, from_above: float = 0.0) -> Up:
    """``axis`` (3,) or its opposite, whichever points up.

    More is seen from above than from below. If about the same is seen, z is up, or -y, as in scenes that have the axes
    of their first camera.

    Args:
        surface: points of the scene.
        axis: (3,) as :func:`upright_axis` gives it.
        from_above: as :func:`~pointsplat_ns.looking.whole.seen_from_above` gives it for ``axis``.
    """
    clear = abs(from_above) >= LOOKING.min_seen_from_above
    sign = 1 if (from_above if clear else _usual(axis)) >= 0 else -1
    return Up(sign * axis, clear)


def _content(surface: Surface) -> Surface:
    """Some of the points near the content; of all points if none is near."""
    near = surface.points.norm(dim=1) < CONTENT_RADIUS
    near = near if bool(near.any()) else torch.ones_like(near)
    return surface[near.nonzero()[:4096, 0]]


def uprightness(axes: Tensor, content: Surface) -> Tensor:
    """Evidence (D,) that a scene stands along axes (D, 3); about 0 if normals have random directions.

    It is the share of level surfaces plus the share of vertical ones, less their mean over random directions, plus the
    largest share of points in one thin level slab.
    """
    deviation, thickness = 8.0, 0.1  # of a normal that counts, degrees; of a slab, units
    weights = content.flatness / content.flatness.sum().clamp_min(1e-300)
    tilt = torch.rad2deg(torch.asin((axes @ content.normals.T).abs().clamp_max(1)))  # [D, n] 90 where level
    level, vertical = ((-0.5 * (angle / deviation).square()).exp() for angle in (90 - tilt, tilt))
    even = torch.rad2deg(torch.asin((torch.arange(1000, **DOUBLES) + 0.5) / 1000))
    chance = sum(float((-0.5 * (angle / deviation).square()).exp().mean()) for angle in (90 - even, even))
    slabs = round(2 * CONTENT_RADIUS / thickness)
    slab = ((axes @ content.points.T + CONTENT_RADIUS) / thickness).long().clamp(0, slabs - 1)
    counts = torch.zeros(len(axes), slabs, **DOUBLES)
    counts.scatter_add_(1, slab, torch.ones_like(slab, dtype=torch.float64))
    thickest = (counts[:, 1:] + counts[:, :-1]).amax(1) / len(content.points)
    return (level + vertical) @ weights - chance * float(weights.sum()) + thickest


def _nearby(axes: Tensor, angle: float) -> Tensor:
    """Axes turned by an angle (radians) to four sides, (4 D, 3)."""
    right = _across(axes)
    other = torch.linalg.cross(axes, right)
    turned = torch.cat([axes + side * math.tan(angle) for side in (right, -right, other, -other)])
    return turned / turned.norm(dim=1, keepdim=True)


def _usual(axis: Tensor) -> float:
    """Cosine of the angle to the usual direction, z or -y, whichever lies nearer to the axis or its opposite."""
    y, z = float(axis[1]), float(axis[2])
    return z if abs(z) > abs(y) else -y
