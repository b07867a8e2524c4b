"""Estimates which way is up in a scene that comes without cameras.

What stands upright has surfaces that are level or vertical (floors, tables, walls, legs), whichever
way furniture is turned; and level surfaces share their heights (a floor, a table top). The
Gaussians show both: the shortest axis of a flat Gaussian is the normal of its surface. And people
photograph from above: more is seen from there than from below.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.geometry.transforms import AXES, axis_along, direction_of, rotation_matrices
from pointsplat_ns.rendering import pixels_of
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.view_sampling.content import UNITS
from pointsplat_ns.view_sampling.poses import around, level_directions, whole_views
from pointsplat_ns.view_sampling.settings import looking

CONTENT_RADIUS = 6.0
"""Distance from the centre of the content within which points belong to it, units."""


@dataclass(frozen=True, eq=False)
class Up:
    """The direction that is up in a scene."""

    direction: Tensor
    """(3,) float64, of length 1."""
    sure: bool = True
    """Whether it was named or declared, or clearly more of the scene is seen from above than from
    below."""

    def __str__(self) -> str:
        """The name of the axis, or the direction.

        Example:
            >>> str(Up(torch.tensor([0.0, -1.0, 0.0]), sure=False))
            '-y (a guess)'
        """
        text = axis_along(self.direction) or " ".join(
            f"{value:.2f}" for value in self.direction.tolist()
        )
        return text if self.sure else f"{text} (a guess)"


def up_named(text: str | None) -> Up | None:
    """The up direction along a world axis, by a name such as "z" or "-y"; None for None.

    Raises:
        PointSplatError: if there is no such axis.
    """
    if text is None:
        return None
    name = text.strip().lower().removeprefix("+")
    if name not in AXES:
        raise PointSplatError(f"up is {text!r}; expected {', '.join(AXES[:-1])} or {AXES[-1]}")
    return Up(direction_of(name))


def known_up(named: Up | None, scene: Gaussians) -> Up | None:
    """The up direction that needs no estimate: the named one, else the one that the scene's file
    declares."""
    return named or up_named(scene.up)


@dataclass(frozen=True, eq=False)
class Surface:
    """Points drawn from the Gaussians of a scene, in its unit. A point lies within its Gaussian."""

    points: Tensor  # [M, 3] float64
    normals: Tensor  # [M, 3] float64, along the shortest axis of the Gaussian, of either sign
    flatness: Tensor  # [M] float64 in [0, 1]: 1 less the ratio of the shortest axis to the next

    @staticmethod
    def of(scene: Gaussians) -> Surface:
        """The surface of a scene of which something is visible. Gaussians are drawn by the root of
        opacity times area: by their number the detail of photos would count alone, and by their
        area the walls."""
        generator = torch.Generator().manual_seed(0)
        alphas = scene.alphas.double()
        count = 12_288
        clear = scene[alphas >= min(looking().min_opacity, float(alphas.max()))]
        logs = 0.5 * (
            F.logsigmoid(clear.opacities[:, 0].double())
            + clear.scales.double().topk(2).values.sum(1)
        )
        ranked = logs.clamp_min(torch.finfo(torch.float64).min).sort().values
        bounded = logs.clamp(
            ranked[0], ranked[int(0.99 * (len(ranked) - 1))]
        )  # a few giants do not count for all
        cumulative = (bounded - ranked[-1]).exp().cumsum(0)
        drawn = torch.rand(count, generator=generator, **DOUBLES) * cumulative[-1]
        some = clear[torch.searchsorted(cumulative, drawn).clamp_max(len(clear) - 1)]
        stds, order = (
            some.stds.double().clamp_max(1e6 * UNITS).sort(dim=1)
        )  # what is farther away is as good as there
        axes = rotation_matrices(some.quats.double()).gather(
            2, order[:, None, :].expand(-1, 3, 3)
        )  # in columns
        offsets = torch.randn(count, 3, generator=generator, **DOUBLES).clamp(-1.5, 1.5) * stds
        points = some.means.double() + (axes @ offsets[..., None])[..., 0]
        return Surface(points, axes[:, :, 0], 1 - stds[:, 0] / stds[:, 1].clamp_min(1e-300))


def upright(few: Gaussians, surface: Surface, traced: bool) -> Up:
    """Which way is up, of a scene in units of its content, with its surface. ``traced`` as
    :func:`upright_axis`.

    It is the end of :func:`upright_axis` from which more is seen. If about the same is seen, z is
    up, or -y, as in scenes that have the axes of their first camera.
    """
    axis = upright_axis(surface, traced)

    def seen_from(up: Tensor) -> int:
        """The largest number of Gaussians that a camera around the content shows."""
        views = whole_views(surface.points, up, around(6), 30.0, 128, 80)
        return max(int((pixels_of(few, view) > 0.1).sum()) for view in views)

    from_above = math.log((seen_from(axis) + 1) / (seen_from(-axis) + 1))
    sure = abs(from_above) >= looking().min_seen_from_above
    y = float(axis[1])
    z = float(axis[2])
    usual = z if abs(z) > abs(y) else -y
    return Up(axis if (from_above if sure else usual) >= 0 else -axis, sure)


def upright_axis(surface: Surface, traced: bool = False) -> Tensor:
    """The axis (3,) along which a scene stands, float64, of length 1 and of either sign.

    It is an axis of the world if that fits about as well as the best direction, and y if that fits
    about as well as the best of the three. A capture, of which ``traced`` says that it shows where
    photos were taken, may have any frame: all axes of the world have a tenth more there, by which
    two of six stand along one.
    """
    near = surface.points.norm(dim=1) < CONTENT_RADIUS
    near = (near if bool(near.any()) else ~near).nonzero()[:4096, 0]
    points = surface.points[near]
    normals = surface.normals[near]
    flatness = surface.flatness[near]
    weights = flatness / flatness.sum().clamp_min(1e-300)

    def uprightness(axes: Tensor) -> Tensor:
        """Evidence (D,) that a scene stands along axes (D, 3): the shares of level and of vertical
        surfaces, less their mean of 0.193 over random directions, and the largest share of points
        in one thin level slab."""
        tilt = torch.rad2deg(
            torch.asin((axes @ normals.T).abs().clamp_max(1))
        )  # [D, n] 90 where level
        level, vertical = ((-0.5 * (angle / 8.0).square()).exp() for angle in (90 - tilt, tilt))
        slab = ((axes @ points.T + CONTENT_RADIUS) / 0.1).long().clamp(0, 119)
        counts = torch.zeros(len(axes), 120, **DOUBLES)
        counts.scatter_add_(1, slab, torch.ones_like(slab, dtype=torch.float64))
        return (level + vertical - 0.193) @ weights + (counts[:, 1:] + counts[:, :-1]).amax(
            1
        ) / len(points)

    index = (
        torch.arange(400, **DOUBLES) + 0.5
    )  # of directions about 7 degrees apart, on Fibonacci's spiral
    height = 1 - index / 400
    ring = (1 - (1 - index / 400).square()).sqrt()
    turn = index * math.pi * (3 - math.sqrt(5))
    axes = torch.stack([ring * turn.cos(), ring * turn.sin(), height], dim=1)
    for degrees in (4.0, 2.0, 1.0, 0.5):
        best = axes[uprightness(axes).topk(8).indices]
        sides = torch.cat([level_directions(axis, around(4)) for axis in best])
        axes = torch.cat(
            [best, best.repeat_interleave(4, 0) + math.tan(math.radians(degrees)) * sides]
        )
        axes = axes / axes.norm(dim=1, keepdim=True)
    scores = uprightness(axes)
    world = torch.eye(3, **DOUBLES)
    of_world = uprightness(world) * (
        1.1 if traced else world.new_tensor(looking().usual_axis_factors)
    )
    return (
        world[of_world.argmax()] if bool(of_world.max() >= scores.max()) else axes[scores.argmax()]
    )
