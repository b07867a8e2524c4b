"""Rays against boxes, ellipsoids and cylinders, in plain torch.

Every primitive is a canonical solid (the cube, ball or cylinder of half-size one) under a rotation
about z and a scale per axis. A ray is taken into that space without normalising its direction, so
its parameter t is the same in both. Primitive 0 is the room itself: a box seen from inside.

Vectors are component first, (3, ...): each component is contiguous, which is what elementwise
kernels want.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

BOX, ELLIPSOID, CYLINDER = 0, 1, 2
CHARTS = {BOX: 6, ELLIPSOID: 1, CYLINDER: 3}
"""Surfaces with a texture of their own: a box's faces (-x, +x, -y, +y, -z, +z), a ball's one, a
cylinder's side, bottom and top."""

T_MIN = 1e-4
_TINY = 1e-12
Components = tuple[Tensor, Tensor, Tensor]


def dot(a, b) -> Tensor:
    """Inner product over the leading axis of 3; faster than a sum over so short an axis."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def unit(v: Tensor) -> Tensor:
    """(3, ...) scaled to length 1; a zero vector stays zero."""
    return v * dot(v, v).clamp(min=1e-30).rsqrt()


@dataclass(frozen=True)
class Primitives:
    """All solids of a room, as tensors.

    Attributes:
        kind: int64 (P,), BOX, ELLIPSOID or CYLINDER.
        center: (P, 3), world.
        half: (P, 3), half extents along the solid's own axes.
        yaw: (P,), rotation about z, radians.
        opaque: bool (P,), whether it casts shadows (lamps and window panes do not).
    """

    kind: Tensor
    center: Tensor
    half: Tensor
    yaw: Tensor
    opaque: Tensor

    def __len__(self) -> int:
        return len(self.kind)

    @property
    def rotation(self) -> Tensor:
        """(P, 3, 3), own axes to world."""
        cos, sin, zero, one = self.yaw.cos(), self.yaw.sin(), torch.zeros_like(self.yaw), torch.ones_like(self.yaw)
        rows = [cos, -sin, zero, sin, cos, zero, zero, zero, one]
        return torch.stack(rows, dim=-1).reshape(-1, 3, 3)

    def solids(self) -> list["_Solid"]:
        """Each primitive as plain numbers, for the loops over rays."""
        rows = zip(self.kind.tolist(), self.center.tolist(), self.half.tolist(), self.yaw.tolist(), strict=True)
        return [
            _Solid(kind, x, y, z, hx, hy, hz, math.cos(yaw), math.sin(yaw))
            for kind, (x, y, z), (hx, hy, hz), yaw in rows
        ]

    def corners(self) -> Tensor:
        """(P, 8, 3), corners of each bounding box, world."""
        signs = torch.tensor([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
        local = signs[None].to(self.half) * self.half[:, None]
        return torch.einsum("pij,pkj->pki", self.rotation, local) + self.center[:, None]

    def distance(self, points: Tensor) -> Tensor:
        """Distance from points (M, 3) to the nearest bounding box of furniture, negative inside: (M,)."""
        offset = points[:, None] - self.center[None, 1:]
        local = torch.einsum("pji,mpj->mpi", self.rotation[1:], offset).abs() - self.half[None, 1:]
        outside = local.clamp(min=0).norm(dim=-1)
        inside = local.amax(dim=-1).clamp(max=0)
        return (outside + inside).amin(dim=-1)


@dataclass(frozen=True)
class _Solid:
    """One primitive as numbers: kind, centre, half extents, cosine and sine of its yaw."""

    kind: int
    x: float
    y: float
    z: float
    hx: float
    hy: float
    hz: float
    cos: float
    sin: float

    def turn(self, x, y, z):
        """World vector to the canonical solid's space (numbers or tensors)."""
        if self.sin == 0.0 and self.cos == 1.0:
            return x * (1 / self.hx), y * (1 / self.hy), z * (1 / self.hz)
        return (
            x * (self.cos / self.hx) + y * (self.sin / self.hx),
            y * (self.cos / self.hy) - x * (self.sin / self.hy),
            z * (1 / self.hz),
        )

    def interval(self, origin, direction) -> tuple[Tensor, Tensor]:
        """:func:`unit_interval` for world origins and directions, each three numbers or tensors."""
        local = self.turn(origin[0] - self.x, origin[1] - self.y, origin[2] - self.z)
        return unit_interval(self.kind, local, self.turn(*direction))


def unit_interval(kind: int, origin, direction: Components) -> tuple[Tensor, Tensor]:
    """Where lines enter and leave a canonical solid.

    Args:
        kind: BOX, ELLIPSOID or CYLINDER.
        origin: Three numbers or tensors (...), in the solid's space.
        direction: Three tensors (...), in the solid's space, of any length.

    Returns:
        (near, far), each (...); near > far where the line misses. Formulas: slabs (Kay and Kajiya
        1986) and the quadratic of the unit ball or disc.
    """
    if kind == BOX:
        near, far = _slab(origin[0], direction[0])
        for axis in (1, 2):
            low, high = _slab(origin[axis], direction[axis])
            near, far = torch.maximum(near, low), torch.minimum(far, high)
        return near, far
    axes = (0, 1, 2) if kind == ELLIPSOID else (0, 1)
    a = sum(direction[i] * direction[i] for i in axes) + _TINY
    middle = -sum(origin[i] * direction[i] for i in axes) / a
    # From the point of the line closest to the centre: no cancellation of large squares.
    gap = 1.0 - sum((origin[i] + middle * direction[i]) ** 2 for i in axes)
    half = (gap.clamp(min=0) / a).sqrt()
    near = torch.where(gap > 0, middle - half, torch.inf)
    far = middle + half
    if kind == CYLINDER:
        low, high = _slab(origin[2], direction[2])
        near, far = torch.maximum(near, low), torch.minimum(far, high)
    return near, far


def _slab(origin, direction: Tensor) -> tuple[Tensor, Tensor]:
    inverse = (direction + _TINY).reciprocal()  # a ray exactly along the slab leans by 1e-12
    middle, half = inverse * -origin, inverse.abs()
    return middle - half, middle + half


def trace(prims: Primitives, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """First hit of each ray.

    Args:
        prims: The room.
        origins: (3, M), inside the room.
        directions: (3, M), any length.

    Returns:
        t (M,), the hit's primitive (M,) and whether the origin lies inside a solid (M,).
    """
    solids = prims.solids()
    _, best = solids[0].interval(origins, directions)
    index = torch.zeros(len(best), dtype=torch.int64)
    buried = torch.zeros(len(best), dtype=torch.bool)
    for p, solid in enumerate(solids[1:], start=1):
        near, far = solid.interval(origins, directions)
        crossed = near < far
        buried |= crossed & (near < -T_MIN) & (far > T_MIN)
        hit = crossed & (near > T_MIN) & (near < best)
        best = torch.where(hit, near, best)
        index.masked_fill_(hit, p)
    return best, index, buried


def occluded(prims: Primitives, origins: Tensor, target: Tensor) -> Tensor:
    """bool (M,): an opaque solid lies between ``origins`` (3, M) and the point ``target`` (3,)."""
    directions = target[:, None] - origins
    blocked = torch.zeros(origins.shape[1], dtype=torch.bool)
    for p, solid in enumerate(prims.solids()):
        if p > 0 and prims.opaque[p]:
            near, far = solid.interval(origins, directions)
            blocked |= (near < far) & (far > T_MIN) & (near < 1.0 - T_MIN)
    return blocked


def trace_camera(prims: Primitives, c2w: Tensor, rays: Tensor, K: Tensor, subpixels: int) -> tuple[Tensor, Tensor]:
    """First hit of a picture's rays, each solid tried only inside its rectangle on screen.

    Args:
        prims: The room.
        c2w: (4, 4) camera-to-world, OpenCV axes.
        rays: (3, H, W) directions in camera space with z = 1, on a regular grid.
        K: (3, 3) intrinsics in pixels, the first pixel's centre at 0.5.
        subpixels: Rays per pixel and axis.

    Returns:
        z (H, W), depth along the optical axis, and the primitive (H, W).
    """
    height, width = rays.shape[1:]
    rotation, eye = c2w[:3, :3], c2w[:3, 3]
    origin = eye.tolist()
    world = torch.einsum("ij,jhw->ihw", rotation, rays)
    solids = prims.solids()
    _, best = solids[0].interval(origin, world)
    index = torch.zeros(height, width, dtype=torch.int64)
    for p, (x0, x1, y0, y1) in enumerate(_rectangles(prims, c2w, K, height, width, subpixels)):
        if p == 0 or x0 >= x1 or y0 >= y1:
            continue
        window = (slice(y0, y1), slice(x0, x1))
        near, far = solids[p].interval(origin, world[:, y0:y1, x0:x1])
        hit = (near < far) & (near > T_MIN) & (near < best[window])
        best[window] = torch.where(hit, near, best[window])
        index[window].masked_fill_(hit, p)
    return best, index


def _rectangles(prims: Primitives, c2w: Tensor, K: Tensor, height: int, width: int, subpixels: int) -> list[list[int]]:
    """Per primitive the columns and rows (x0, x1, y0, y1) of rays that can meet it; x0 >= x1 for none."""
    corners = (prims.corners() - c2w[:3, 3]) @ c2w[:3, :3]  # [P, 8, 3], camera space
    x, y, z = corners.unbind(-1)
    ahead = z > 1e-3
    safe = z.clamp(min=1e-3)
    u = (x / safe * K[0, 0] + K[0, 2]) * subpixels
    v = (y / safe * K[1, 1] + K[1, 2]) * subpixels
    sides = [
        (u.amin(1).floor() - 1).clamp(0, width),
        (u.amax(1).ceil() + 1).clamp(0, width),
        (v.amin(1).floor() - 1).clamp(0, height),
        (v.amax(1).ceil() + 1).clamp(0, height),
    ]
    rectangle = torch.stack(sides, dim=1).long()
    crossing = ~ahead.all(1)  # through the camera's plane: could be anywhere on screen
    rectangle[crossing] = torch.tensor([0, width, 0, height])
    rectangle[~ahead.any(1)] = 0
    return rectangle.tolist()


@dataclass(frozen=True)
class Hits:
    """Where rays met surfaces: chart (M,) among all charts, u and v (M,) in [0, 1], normal (3, M)."""

    chart: Tensor
    u: Tensor
    v: Tensor
    normal: Tensor


def chart_starts(prims: Primitives) -> Tensor:
    """int64 (P,): number of each primitive's first chart."""
    counts = torch.tensor([CHARTS[int(k)] for k in prims.kind])
    return torch.cumsum(counts, 0) - counts


def surface(prims: Primitives, points: Tensor, index: Tensor) -> Hits:
    """Chart, texture coordinates and normal of points (3, M) on the primitives ``index`` (M,).

    On vertical surfaces v runs downwards and u to the right as seen by who looks at them.
    """
    inward = torch.ones(len(prims))
    inward[0] = -1.0
    table = torch.cat([prims.center.T, prims.half.T, prims.yaw.cos()[None], prims.yaw.sin()[None], inward[None]])
    cx, cy, cz, hx, hy, hz, cos, sin, inward = table.index_select(1, index).unbind(0)
    dx, dy, dz = points[0] - cx, points[1] - cy, points[2] - cz
    x, y, z = (cos * dx + sin * dy) / hx, (cos * dy - sin * dx) / hy, dz / hz
    kind = prims.kind[index]

    # Boxes: the face is the largest component. To the right of who faces +x is +y, of who faces +y
    # is -x; the other way round inside.
    ax, ay, az = x.abs(), y.abs(), z.abs()
    on_x, on_z = (ax >= ay) & (ax >= az), (az > ax) & (az > ay)
    major = torch.where(on_x, x, torch.where(on_z, z, y))
    sign = torch.where(major > 0, inward, -inward)
    right = torch.where(on_x, y * sign, torch.where(on_z, x, -x * sign))
    down = torch.where(on_z, -y, -z)
    face = torch.where(on_x, 0, torch.where(on_z, 4, 2)) + (major > 0)
    zero = torch.zeros_like(x)
    nx, nz = torch.where(on_x, sign, zero), torch.where(on_z, sign, zero)
    ny = torch.where(on_x | on_z, zero, sign)

    curved = (kind != BOX).nonzero()[:, 0]
    if len(curved):
        x, y, z, hx, hy, hz = (value[curved] for value in (x, y, z, hx, hy, hz))
        tube = kind[curved] == CYLINDER
        cap = tube & (z.abs() > 1 - 1e-4) & (x * x + y * y < 1 - 1e-6)
        right[curved] = torch.where(cap, x, torch.atan2(y, x) / math.pi)
        polar = torch.acos(z.clamp(-1, 1)) / math.pi * 2 - 1
        down[curved] = torch.where(cap, -y, torch.where(tube, -z, polar))
        face[curved] = torch.where(cap, 1 + (z > 0).long(), 0)
        # Gradient of the implicit function.
        nx[curved], ny[curved] = torch.where(cap, 0.0, x / hx), torch.where(cap, 0.0, y / hy)
        nz[curved] = torch.where(cap, z.sign(), torch.where(tube, 0.0, z / hz))
    normal = unit(torch.stack([cos * nx - sin * ny, sin * nx + cos * ny, nz]))
    return Hits(
        chart=chart_starts(prims)[index] + face,
        u=(right * 0.5 + 0.5).clamp(0, 1),
        v=(down * 0.5 + 0.5).clamp(0, 1),
        normal=normal,
    )


def chart_points(prims: Primitives, p: int, face: int, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """World points and normals, (3, M) each, of texture coordinates (M,): the inverse of :func:`surface`."""
    kind = int(prims.kind[p])
    right, down = u * 2 - 1, v * 2 - 1
    if kind == BOX:
        axis, sign = face // 2, (1.0 if face % 2 else -1.0)
        facing = -sign if p == 0 else sign
        fixed = torch.full_like(right, sign)
        if axis == 0:
            spot = torch.stack([fixed, right * facing, -down])
        elif axis == 1:
            spot = torch.stack([-right * facing, fixed, -down])
        else:
            spot = torch.stack([right, -down, fixed])
        normal = torch.zeros_like(spot)
        normal[axis] = facing
    else:
        if kind == ELLIPSOID:
            polar, angle = v * math.pi, right * math.pi
            spot = torch.stack([polar.sin() * angle.cos(), polar.sin() * angle.sin(), polar.cos()])
            normal = spot.clone()
        elif face == 0:
            spot = torch.stack([(right * math.pi).cos(), (right * math.pi).sin(), -down])
            normal = torch.stack([spot[0], spot[1], torch.zeros_like(right)])
        else:
            # The corners of the cap's square texture are pulled onto the disc: every texel lies on it.
            radius = (right * right + down * down).sqrt().clamp(min=1.0)
            spot = torch.stack([right / radius, -down / radius, torch.full_like(right, 1.0 if face == 2 else -1.0)])
            normal = torch.stack([torch.zeros_like(right), torch.zeros_like(right), spot[2]])
        normal = unit(normal / prims.half[p][:, None])
    rotation = prims.rotation[p]
    return rotation @ (spot * prims.half[p][:, None]) + prims.center[p][:, None], rotation @ normal


def chart_size(prims: Primitives, p: int, face: int) -> tuple[float, float]:
    """Width and height of a chart in metres (a ball's and a tube's unrolled)."""
    hx, hy, hz = prims.half[p].tolist()
    kind = int(prims.kind[p])
    if kind == BOX:
        return ((2 * hy, 2 * hz), (2 * hx, 2 * hz), (2 * hx, 2 * hy))[face // 2]
    girth = math.pi * (hx + hy)
    if kind == ELLIPSOID:
        return girth, math.pi * hz
    return (girth, 2 * hz) if face == 0 else (2 * hx, 2 * hy)
