"""Rays against axis-aligned boxes and ellipsoids, in plain torch.

Solid 0 is the room itself, a box seen from inside. Every solid has six charts, the faces of its
bounding box in the order -x, +x, -y, +y, -z, +z; an ellipsoid takes its texture from the box around
it. Vectors are (3, M).
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.system.tensors import FLAGS, INDICES


def dot(a, b) -> Tensor:
    """Inner product over the leading axis of 3; faster than a sum over so short an axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def unit(v: Tensor) -> Tensor:
    """(3, ...) scaled to length 1; a zero vector stays zero."""
    return v * dot(v, v).clamp(min=1e-30).rsqrt()


@dataclass(frozen=True)
class Solids:
    """All solids of a room.

    Attributes:
        center: (S, 3), world, metres.
        half: (S, 3), half extents, metres.
        round: bool (S,), True for an ellipsoid, False for a box.
        opaque: bool (S,), whether it casts shadows; lamps and window panes do not.
    """

    center: Tensor
    half: Tensor
    round: Tensor
    opaque: Tensor

    def __len__(self) -> int:
        return len(self.center)

    def interval(self, number: int, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """Where lines from ``origins`` (3, M) or (3, 1), world, along ``directions`` (3, M) enter
        and leave a solid.

        Returns (near, far), each (M,), in multiples of the direction; near >= far where the line
        misses. Formulas: slabs (Kay and Kajiya 1986) and the quadratic of the unit ball.
        """
        half = self.half[number, :, None]
        origins = (origins - self.center[number, :, None]) / half
        directions = directions / half
        if not self.round[number]:
            inverse = (directions + 1e-12).reciprocal()  # a ray exactly along a face leans a little
            middle = -origins * inverse
            reach = inverse.abs()
            return (middle - reach).amax(0), (middle + reach).amin(0)
        square = dot(directions, directions)
        middle = -dot(origins, directions) / square
        # From the point of the line closest to the centre: no cancellation of large squares.
        nearest = origins + middle * directions
        gap = 1 - dot(nearest, nearest)
        reach = (gap.clamp(min=0) / square).sqrt()
        return middle - reach, middle + reach


def trace(solids: Solids, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """First hit of rays from ``origins`` (3, M), or (3, 1) for a camera's, inside the room along
    ``directions`` (3, M): its distance in multiples of the direction and the solid, each (M,)."""
    _, best = solids.interval(0, origins, directions)
    index = torch.zeros(len(best), **INDICES)
    for number in (
        _in_cone(solids, origins, directions) if origins.shape[1] == 1 else range(1, len(solids))
    ):
        near, far = solids.interval(number, origins, directions)
        hit = (near < far) & (near > 1e-4) & (near < best)
        best = torch.where(hit, near, best)
        index.masked_fill_(hit, number)
    return best, index


def _in_cone(solids: Solids, origin: Tensor, directions: Tensor) -> list[int]:
    """Numbers of the solids, but the room, whose bounding spheres meet the cone around all rays
    from one point."""
    rays = unit(directions)
    axis = unit(rays.sum(1))
    opening = torch.acos((axis @ rays).min().clamp(-1, 1))
    offset = solids.center.T - origin
    distance = offset.norm(dim=0)
    radius = solids.half.norm(dim=1)
    between = torch.acos((axis @ unit(offset)).clamp(-1, 1))
    meets = between <= opening + torch.asin((radius / distance).clamp(max=1)) + 1e-3
    return [
        number for number in (meets | (distance <= radius)).nonzero()[:, 0].tolist() if number > 0
    ]


def occluded(solids: Solids, origins: Tensor, target: Tensor) -> Tensor:
    """bool (M,): an opaque solid lies between ``origins`` (3, M) and the point ``target`` (3,)."""
    directions = target[:, None] - origins
    blocked = torch.zeros(origins.shape[1], **FLAGS)
    for number in solids.opaque[1:].nonzero()[:, 0].tolist():
        near, far = solids.interval(number + 1, origins, directions)
        blocked |= (near < far) & (far > 1e-4) & (near < 1 - 1e-4)
    return blocked


@dataclass(frozen=True)
class Hits:
    """Hits of rays on surfaces: chart (M,), which is 6 x solid + face, u and v (M,) in [0, 1],
    normal (3, M)."""

    chart: Tensor
    u: Tensor
    v: Tensor
    normal: Tensor


def surface(solids: Solids, points: Tensor, index: Tensor) -> Hits:
    """Chart, texture coordinates and normal of points (3, M) on the solids ``index`` (M,).

    On vertical faces v runs downwards and u to the right as seen by who looks at them.
    """
    half = solids.half[index].T
    local = (points - solids.center[index].T) / half
    distance, axis = local.abs().max(0)
    x, y, z = local / distance  # on the cube around the solid
    sign = local.gather(0, axis[None])[0].sign()
    facing = torch.where(index == 0, -sign, sign)
    right = torch.where(axis == 0, y * facing, torch.where(axis == 1, -x * facing, x))
    down = torch.where(axis == 2, -y, -z)
    flat = torch.zeros_like(local).scatter_(0, axis[None], facing[None])
    return Hits(
        chart=6 * index + 2 * axis + (sign > 0),
        u=(right * 0.5 + 0.5).clamp(0, 1),
        v=(down * 0.5 + 0.5).clamp(0, 1),
        normal=torch.where(solids.round[index], unit(local / half), flat),
    )


def chart_points(solids: Solids, chart: int, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """World points and normals, (3, M) each, of texture coordinates (M,): the inverse of
    :func:`surface`."""
    number = chart // 6
    (axis, positive) = divmod(chart % 6, 2)
    sign = 2.0 * positive - 1
    facing = -sign if number == 0 else sign
    fixed = torch.full_like(u, sign)
    right = 2 * u - 1
    down = 2 * v - 1
    rows = ([fixed, right * facing, -down], [-right * facing, fixed, -down], [right, -down, fixed])[
        axis
    ]
    spot = torch.stack(rows)
    half = solids.half[number, :, None]
    normal = torch.zeros_like(spot)
    normal[axis] = facing
    if solids.round[number]:
        spot = unit(spot)
        normal = unit(spot / half)
    return solids.center[number, :, None] + half * spot, normal


def chart_size(solids: Solids, chart: int) -> tuple[float, float]:
    """Width and height of a chart in metres."""
    x, y, z = (2 * solids.half[chart // 6]).tolist()
    return ((y, z), (x, z), (x, y))[chart % 6 // 2]
