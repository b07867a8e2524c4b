"""Estimates which way is up in a scene that comes without cameras.

What stands upright has surfaces that are level or vertical (floors, tables, walls, legs), whichever way furniture is
turned; and level surfaces share their heights (a floor, a table top). Both are seen in the Gaussians: a flat one's
shortest axis is the normal of its surface. Where photos were taken says more, if it is known: people move about, and
hold cameras at about one height.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.looking.content import UNITS
from pointsplat_ns.looking.surface import Surface

USED = 4096
"""Number of points, at most, that are looked at."""

_CONTENT = 6.0
"""Points farther from the centre of the content, in its units, tell nothing about it."""

_DIRECTIONS = 400
"""Directions tried, evenly over half of a sphere: about 7 degrees apart."""

_WIDTH = 8.0
"""Standard deviation of the angle within which a surface counts as level or vertical, degrees."""

_YAW = 5.0
"""Degrees between the upright boxes that are tried."""

_SLAB = 0.1
"""Thickness of the slabs that points are counted in by height, units; two neighbours hold one level surface."""

_USUAL = (1.3, 1.64)
"""Factors of the scores of the world's z and y axes. Most scenes stand along y, as COLMAP's first camera does, or along
z, as nerfstudio's do; and in a room, walls are as flat as the floor. Of 23 scenes whose up is known, 17 are found
within 10 degrees; 14 were without these factors and :data:`_CUSTOM`."""

_USUAL_WITH_PHOTOS = (1.05, 1.05)
"""The same where it is known where photos were taken, which says more."""

_WEAK = 0.07
"""Scores below this are found in scenes without any level or vertical surface."""

_PHOTOS_LEVEL = 0.1
"""Weight of how level the places of photos lie. On a desk that was walked around half of it would be enough; without
it, the desk's up is 88 degrees wrong."""

_CUSTOM = 0.25
"""How far above the middle the weight must lie along a world axis that usually points up, as a share of the height, to
say that it points down. Bouquets and plants are widest at their top."""


@dataclass(frozen=True, eq=False)
class UprightBox:
    """The box that stands upright around most of a scene, in units of its content."""

    frame: Tensor  # [3, 3] float64, orthonormal rows: two level directions and the upright one
    low: Tensor  # [3] float64, its corners along these
    high: Tensor  # [3] float64

    @property
    def up(self) -> Tensor:
        """The upright direction (3,)."""
        return self.frame[2]

    @staticmethod
    def of(surface: Surface, up: Tensor) -> UprightBox:
        """The narrowest of the boxes that hold nine tenths of the points along each axis, with ``up`` (3,) upright."""
        points = _Content.of(surface).points
        turn = torch.arange(0, math.pi / 2, math.radians(_YAW), dtype=torch.float64)
        right, ahead = level_directions(up, turn), level_directions(up, turn + math.pi / 2)
        frames = torch.stack([right, ahead, up.expand_as(right)], dim=1)  # [T, 3, 3]
        along = frames @ points.T
        low, high = along.quantile(along.new_tensor([0.05, 0.95]), dim=2)
        narrowest = int((high - low)[:, :2].prod(1).argmin())
        return UprightBox(frames[narrowest], low[narrowest], high[narrowest])

    def places(self, count: int, generator: torch.Generator) -> Tensor:
        """Positions (count, 3) drawn evenly from the box; a side that is very short is lengthened."""
        middle, half = 0.5 * (self.low + self.high), 0.5 * (self.high - self.low).clamp_min(0.25 * UNITS)
        share = 2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1
        return (middle + share * half) @ self.frame

    def heights(self, places: Tensor) -> Tensor:
        """Heights of places (P, 3): 0 at the bottom of the box, 1 at its top."""
        return (places @ self.up - self.low[2]) / (self.high[2] - self.low[2]).clamp_min(1e-300)


def level_directions(up: Tensor, turn: Tensor) -> Tensor:
    """Directions (n, 3) across ``up`` (3,), by their angle (n,) about it, radians."""
    right = _across(up)
    return turn.cos()[:, None] * right + turn.sin()[:, None] * torch.linalg.cross(up, right)


def _across(axes: Tensor) -> Tensor:
    """A direction at a right angle to each axis (..., 3)."""
    right = torch.linalg.cross(axes, torch.eye(3, dtype=axes.dtype)[axes.abs().argmin(-1)])
    return right / right.norm(dim=-1, keepdim=True)


def upright_axis(surface: Surface, photos: tuple[Tensor, Tensor] | None = None) -> Tensor:
    """The axis (3,) that a scene stands along, float64, of length 1 and of either sign.

    The y axis of the world, or the z axis, where it fits about as well as any other direction, and the z axis where
    the scene gives no evidence.

    Args:
        surface: points of the scene.
        photos: places (P, 3) where photos were taken, in units of the content, and their shares (P,), if known.
    """
    content = _Content.of(surface)
    axis = _axis(content, photos) if len(content.points) > 1 else None
    return torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) if axis is None else axis


def pointing_up(surface: Surface, axis: Tensor, inside: bool) -> Tensor:
    """``axis`` (3,) or its opposite, whichever points up.

    By what is seen; where that says little, z is up, and -y, as in scenes that have the axes of their first camera.

    Args:
        surface: points of the scene.
        axis: as :func:`upright_axis` gives it.
        inside: whether the scene is a room that is looked at from inside.
    """
    return axis if _lift(_Content.of(surface), axis, inside) + _usual(axis) >= 0 else -axis


@dataclass(frozen=True, eq=False)
class _Content:
    """Some of the points near the content; of all points if none is near. As :class:`Surface` has them."""

    points: Tensor
    normals: Tensor
    flatness: Tensor
    shown: Tensor

    @staticmethod
    def of(surface: Surface) -> _Content:
        near = surface.points.norm(dim=1) < _CONTENT
        near = near if bool(near.any()) else torch.ones_like(near)
        chosen = near.nonzero()[:USED, 0]
        return _Content(
            surface.points[chosen], surface.normals[chosen], surface.flatness[chosen], surface.shown[chosen].double()
        )


def _axis(content: _Content, photos: tuple[Tensor, Tensor] | None) -> Tensor | None:
    """The upright axis (3,), of either sign; None without evidence."""

    def scores_of(axes: Tensor) -> Tensor:
        scores = uprightness(axes, content.points, content.normals, content.flatness)
        return scores if photos is None else scores + _PHOTOS_LEVEL * levelness(axes, *photos)

    index = torch.arange(_DIRECTIONS, dtype=torch.float64) + 0.5
    height = 1 - index / _DIRECTIONS  # Fibonacci's spiral
    turn = index * math.pi * (3 - math.sqrt(5))
    ring = (1 - height.square()).sqrt()
    around = torch.stack([ring * turn.cos(), ring * turn.sin(), height], dim=1)
    found = around[scores_of(around).topk(8).indices]
    for degrees in (4.0, 2.0, 1.0, 0.5):
        found = torch.cat([found, _nearby(found, math.radians(degrees))])
        scores = scores_of(found)
        found = found[scores.topk(8).indices]
    best = float(scores.max())
    if best < _WEAK:
        return None
    usual = torch.tensor([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]], dtype=torch.float64)
    factors = usual.new_tensor(_USUAL if photos is None else _USUAL_WITH_PHOTOS)
    scores = factors * scores_of(usual)
    return usual[scores.argmax()] if float(scores.max()) >= best else found[0]


def levelness(axes: Tensor, places: Tensor, shares: Tensor) -> Tensor:
    """How level places lie across axes, (D,) float64 in [0, 1].

    1 less the standard deviation of their heights, relative to that along the direction in which they spread most; 0
    for places that do not spread.

    Args:
        axes: (D, 3) of length 1.
        places: (P, 3).
        shares: (P,) weights, which sum to 1.
    """
    places, shares = places.double(), shares.double()
    offsets = places - shares @ places
    spread = offsets.T @ (shares[:, None] * offsets)
    widest = torch.linalg.eigvalsh(spread)[-1]
    if float(widest) <= 0:
        return torch.zeros(len(axes), dtype=torch.float64)
    along = (axes @ spread * axes).sum(1).clamp_min(0)
    return 1 - (along / widest).clamp_max(1).sqrt()


def uprightness(axes: Tensor, points: Tensor, normals: Tensor, flatness: Tensor) -> Tensor:
    """How well axes (D, 3) suit as the upright one, (D,); about 0 where all directions are alike.

    The share of normals along the axis and the share of those across it, each less what chance gives, and the largest
    share of points in one thin slab across the axis.
    """
    weights = flatness / flatness.sum().clamp_min(1e-300)
    tilt = torch.rad2deg(torch.asin((axes @ normals.T).abs().clamp_max(1)))  # [D, n] 90 where level
    level, vertical = ((-0.5 * (angle / _WIDTH).square()).exp() for angle in (90 - tilt, tilt))
    even = torch.rad2deg(torch.asin((torch.arange(1000, dtype=torch.float64) + 0.5) / 1000))
    chance = sum(float((-0.5 * (angle / _WIDTH).square()).exp().mean()) for angle in (90 - even, even))
    slabs = round(2 * _CONTENT / _SLAB)
    slab = ((axes @ points.T + _CONTENT) / _SLAB).long().clamp(0, slabs - 1)
    counts = torch.zeros(len(axes), slabs, dtype=torch.float64)
    counts.scatter_add_(1, slab, torch.ones_like(slab, dtype=torch.float64))
    thickest = (counts[:, 1:] + counts[:, :-1]).amax(1) / len(points)
    return (level + vertical) @ weights - chance * float(weights.sum()) + thickest


def _nearby(axes: Tensor, angle: float) -> Tensor:
    """Axes turned by an angle (radians) to four sides, (4 D, 3)."""
    right = _across(axes)
    other = torch.linalg.cross(axes, right)
    turned = torch.cat([axes + side * math.tan(angle) for side in (right, -right, other, -other)])
    return turned / turned.norm(dim=1, keepdim=True)


def _lift(content: _Content, axis: Tensor, inside: bool) -> float:
    """How far below the middle the weight lies, as a share of the height: above 0 if the axis points up.

    A room has its furniture below. What is looked at from outside stands on a base or on the ground, which is wide: its
    points count by their distance from the vertical line through the middle. All count by the root of how much photos
    showed of them: people look at what stands on the floor.
    """
    heights = content.points @ axis
    low, high = heights.quantile(heights.new_tensor([0.02, 0.98]))
    share = ((heights - low) / (high - low).clamp_min(1e-300)).clamp(0, 1)
    weights = content.shown.sqrt()
    if not inside:
        beside = content.points - heights[:, None] * axis
        weights = weights * (beside - weights @ beside / weights.sum()).norm(dim=1)
    total = float(weights.sum())
    return 0.5 - float(weights @ share) / total if total > 0 else 0.0


def _usual(axis: Tensor) -> float:
    """Above 0 for an axis that usually points up, z or -y, below 0 for its opposite, and less where it is tilted."""
    y, z = float(axis[1]), float(axis[2])
    return _CUSTOM * (z if abs(z) > abs(y) else -y)
