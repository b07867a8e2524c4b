"""Estimates the up direction of a scene without cameras.

Upright scenes have level and vertical surfaces (floors, tables, walls, legs), however furniture is
turned; and level surfaces have common heights (a floor, a table top). Gaussians show both: the
shortest axis of a flat Gaussian is the normal of its surface. People also photograph from above:
more is visible from there than from below.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.geometry.transforms import AXES, axis_along, direction_of, rotation_matrices
from pointsplat_ns.rendering import pixels_of_each
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.system.files import logger
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.view_sampling.content import UNITS
from pointsplat_ns.view_sampling.poses import around, level_directions, whole_views
from pointsplat_ns.view_sampling.settings import current_settings

CONTENT_RADIUS = 6.0
"""Distance from the content's centre within which points belong to it, units."""


@dataclass(frozen=True, eq=False)
class Up:
    """The up direction of a scene."""

    direction: Tensor
    """(3,) float64, unit length."""
    sure: bool = True
    """Whether it was named, or declared and not contradicted by the scene, or clearly more of the
    scene is visible from above than from below."""
    instead: str = ""
    """The direction that the scene suggests in place of a declared one; empty if it contradicts
    none."""

    def __str__(self) -> str:
        """Name of the axis, or the direction, and whether it is uncertain.

        Example:
            >>> str(Up(torch.tensor([0.0, -1.0, 0.0]), sure=False))
            '-y (a guess)'
        """
        text = axis_along(self.direction) or " ".join(
            f"{value:.2f}" for value in self.direction.tolist()
        )
        if self.instead:
            return f"{text} (declared, but the scene suggests {self.instead})"
        return text if self.sure else f"{text} (a guess)"


def up_named(text: str | None) -> Up | None:
    """The up direction along a world axis, by a name such as "z" or "-y"; None for None.

    Raises:
        PointSplatError: for any other name.
    """
    if text is None:
        return None
    name = text.strip().lower().removeprefix("+")
    if name not in AXES:
        raise PointSplatError(f"up is {text!r}; expected {', '.join(AXES[:-1])} or {AXES[-1]}")
    return Up(direction_of(name))


def known_up(named: Up | None, scene: Gaussians) -> Up | None:
    """The up direction without an estimate: named, or else declared by the scene's file."""
    return named or (None if scene.up is None else Up(direction_of(scene.up)))


@dataclass(frozen=True, eq=False)
class Surface:
    """Points sampled from the Gaussians of a scene, in its unit; each is within its Gaussian."""

    points: Tensor  # [M, 3] float64
    normals: Tensor  # [M, 3] float64, along the Gaussian's shortest axis, of either sign
    flatness: Tensor  # [M] float64 in [0, 1]: 1 minus the ratio of the shortest axis to the next

    @functools.cached_property
    def content(self) -> tuple[Tensor, Tensor, Tensor]:
        """Points (n, 3), normals (n, 3) and flatness (n,) of the first 4,096 points that belong to
        the content; of the others if none does."""
        near = self.points.norm(dim=1) < CONTENT_RADIUS
        near = (near if bool(near.any()) else ~near).nonzero()[:4096, 0]
        return self.points[near], self.normals[near], self.flatness[near]

    @staticmethod
    def of(scene: Gaussians) -> Surface:
        """The surface of a scene with visible content. Gaussians are sampled by the square root of
        opacity times area: sampling by number would favour the detail of photos, and by area the
        walls."""
        generator = torch.Generator().manual_seed(0)
        alphas = scene.alphas.double()
        count = 12_288
        clear = scene[alphas >= min(current_settings().min_opacity, float(alphas.max()))]
        logs = 0.5 * (
            F.logsigmoid(clear.opacities[:, 0].double())
            + clear.scales.double().topk(2).values.sum(1)
        )
        ranked = logs.clamp_min(torch.finfo(torch.float64).min).sort().values
        # so that a few giants do not dominate
        bounded = logs.clamp(ranked[0], ranked[int(0.99 * (len(ranked) - 1))])
        cumulative = (bounded - ranked[-1]).exp().cumsum(0)
        drawn = torch.rand(count, generator=generator, **DOUBLES) * cumulative[-1]
        some = clear[torch.searchsorted(cumulative, drawn).clamp_max(len(clear) - 1)]
        # larger deviations count as this one
        stds, order = some.stds.double().clamp_max(1e6 * UNITS).sort(dim=1)
        # in columns
        axes = rotation_matrices(some.quats.double()).gather(2, order[:, None, :].expand(-1, 3, 3))
        offsets = torch.randn(count, 3, generator=generator, **DOUBLES).clamp(-1.5, 1.5) * stds
        points = some.means.double() + (axes @ offsets[..., None])[..., 0]
        return Surface(points, axes[:, :, 0], 1 - stds[:, 0] / stds[:, 1].clamp_min(1e-300))


def upright(few: Gaussians, surface: Surface, traced: bool) -> Up:
    """Up direction of a scene in units of its content, from its surface. ``traced`` is as for
    :func:`upright_axis`.

    It is the end of :func:`upright_axis` from which more is visible. If the difference is small, z
    is up, or -y, as in scenes in the frame of their first camera.
    """
    return _upper_end(upright_axis(surface, traced), few, surface)


def _upper_end(axis: Tensor, few: Gaussians, surface: Surface) -> Up:
    """The end of an axis that :func:`upright` takes."""
    from_above = _seen_from_above(few, surface, axis)
    sure = abs(from_above) >= current_settings().min_seen_from_above
    y = float(axis[1])
    z = float(axis[2])
    usual = z if abs(z) > abs(y) else -y
    return Up(axis if (from_above if sure else usual) >= 0 else -axis, sure)


def _seen_from_above(few: Gaussians, surface: Surface, up: Tensor) -> float:
    """Logarithm of the ratio of the Gaussians visible from above to those visible from below."""

    def seen(up: Tensor) -> int:
        """Maximum number of Gaussians that a camera around the content shows."""
        views = whole_views(surface.points, up, around(6), 30.0, 128, 80)
        return int((pixels_of_each(few, views) > 0.1).sum(1).max())

    return math.log((seen(up) + 1) / (seen(-up) + 1))


def checked_up(declared: Up, few: Gaussians, surface: Surface, traced: bool) -> Up:
    """The declared up direction of a scene, and the one that the scene suggests instead, if it
    contradicts: far more is visible from below than from above, or another axis has far more level
    and vertical surfaces. The second is no evidence against a direction along no axis, such as the
    mean of cameras, which may be many degrees off. A contradiction is logged as a warning, once for
    each pair of directions. Arguments are those of :func:`upright`.
    """
    settings = current_settings()
    up = declared.direction
    other = None
    if _seen_from_above(few, surface, up) < -settings.min_seen_from_below:
        other = Up(-up)
    elif axis_along(up) is not None:
        axis = upright_axis(surface, traced)
        rightness = _uprightness(surface, torch.stack([up, axis]))
        if (
            float(rightness[1]) > settings.min_other_uprightness
            and float(rightness[0] / rightness[1]) < settings.max_declared_uprightness
            and abs(float(up @ axis)) < math.cos(math.radians(45))
        ):
            other = Up(_upper_end(axis, few, surface).direction)
    if other is None:
        return declared
    _warn_of_contradiction(str(declared), str(other), axis_along(other.direction) or "")
    return Up(up, sure=False, instead=str(other))


@functools.lru_cache(maxsize=64)
def _warn_of_contradiction(declared: str, other: str, axis: str) -> None:
    """Log that a scene contradicts its declared up direction; a command samples views several
    times."""
    hint = f"; if it is right, set it with --up={axis}" if axis else ""
    logger.warning("the file declares %s as up, but the scene suggests %s%s", declared, other, hint)


def upright_axis(surface: Surface, traced: bool = False) -> Tensor:
    """Vertical axis (3,) of a scene, float64, unit length, either sign.

    It is a world axis if that fits about as well as the best direction, and y if that fits about as
    well as the best of the three. A capture may have any frame, if ``traced`` says that it shows
    where photos were taken: there all world axes get a tenth more, which aligns two of six captures
    with one.
    """
    # directions about 7 degrees apart, on a Fibonacci spiral
    index = torch.arange(400, **DOUBLES) + 0.5
    height = 1 - index / 400
    ring = (1 - (1 - index / 400).square()).sqrt()
    turn = index * math.pi * (3 - math.sqrt(5))
    axes = torch.stack([ring * turn.cos(), ring * turn.sin(), height], dim=1)
    for degrees in (4.0, 2.0, 1.0, 0.5):
        best = axes[_uprightness(surface, axes).topk(8).indices]
        sides = torch.cat([level_directions(axis, around(4)) for axis in best])
        axes = torch.cat(
            [best, best.repeat_interleave(4, 0) + math.tan(math.radians(degrees)) * sides]
        )
        axes = axes / axes.norm(dim=1, keepdim=True)
    scores = _uprightness(surface, axes)
    world = torch.eye(3, **DOUBLES)
    of_world = _uprightness(surface, world) * (
        1.1 if traced else world.new_tensor(current_settings().usual_axis_factors)
    )
    return (
        world[of_world.argmax()] if bool(of_world.max() >= scores.max()) else axes[scores.argmax()]
    )


def _uprightness(surface: Surface, axes: Tensor) -> Tensor:
    """Evidence (D,) for vertical axes (D, 3): the shares of level and of vertical surfaces, minus
    their mean of 0.193 over random directions, plus the largest share of points in one thin level
    slab."""
    points, normals, flatness = surface.content
    weights = flatness / flatness.sum().clamp_min(1e-300)
    # [D, n] 90 where level
    tilt = torch.rad2deg(torch.asin((axes @ normals.T).abs().clamp_max(1)))
    level, vertical = ((-0.5 * (angle / 8.0).square()).exp() for angle in (90 - tilt, tilt))
    slab = ((axes @ points.T + CONTENT_RADIUS) / 0.1).long().clamp(0, 119)
    counts = torch.zeros(len(axes), 120, **DOUBLES)
    counts.scatter_add_(1, slab, torch.ones_like(slab, dtype=torch.float64))
    in_slab = (counts[:, 1:] + counts[:, :-1]).amax(1) / len(points)
    return (level + vertical - 0.193) @ weights + in_slab
