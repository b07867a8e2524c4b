"""Textures and light of a room, computed once and looked up by every render.

Colours go into mip-mapped texel grids, one per chart. Light that does not depend on the viewer
(direct light with soft shadows from area lights, and several bounces between surfaces) goes into a
coarser grid, together with the visible share of each light, which the highlights need.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pointsplat_ns.rooms.building import Light, RoomSpec
from pointsplat_ns.rooms.raycast import CHARTS, chart_points, chart_size, dot, occluded, surface, trace, unit
from pointsplat_ns.rooms.textures import Canvas
from pointsplat_ns.system.threads import one_thread

TEXEL = 0.0075  # metres: a pixel of a 320 x 240 picture with 78 degrees covers that at 1.5 m
LUMEL = 0.12  # metres between points where light is computed
MAX_LEVELS = 10
BOUNCES = 4
HEMISPHERE = 32  # rays a point gathers bounced light with
LIGHT_SIDE = 4  # an area light is sampled at 4 x 4 points
_GAP_LIGHT = 0.25  # share of the mean light that reaches the gaps between touching solids
_CHUNK = 1 << 15  # rays traced at once: temporaries stay in the cache


@dataclass(frozen=True)
class Grid:
    """Grids of all charts, one after the other.

    Attributes:
        data: (T, C) values; chart c at level l starts at ``start[c, l]``, rows of ``columns[c, l]``.
        start, columns, rows: int64 (charts, levels).
        levels: int64 (charts,), number of levels of each chart.
        spacing: (charts,), metres between points of level 0.
    """

    data: Tensor
    start: Tensor
    columns: Tensor
    rows: Tensor
    levels: Tensor
    spacing: Tensor

    def sample(self, chart: Tensor, u: Tensor, v: Tensor, level: Tensor) -> Tensor:
        """Bilinear value (M, C) at one integer level (M,) per point; clamped at the charts' borders."""
        cell = chart * self.start.shape[1] + level
        start, columns, rows = (grid.view(-1).index_select(0, cell) for grid in (self.start, self.columns, self.rows))
        x = (u * columns - 0.5).clamp_(min=0)
        y = (v * rows - 0.5).clamp_(min=0)
        i, j = x.long(), y.long()
        fx, fy = (x - i)[:, None], (y - j)[:, None]
        corner = start + j * columns + i
        right = (i + 1 < columns).long()
        below = torch.where(j + 1 < rows, columns, 0)

        def at(place: Tensor) -> Tensor:
            return self.data.index_select(0, place)

        upper = torch.lerp(at(corner), at(corner + right), fx)
        corner = corner + below
        lower = torch.lerp(at(corner), at(corner + right), fx)
        return torch.lerp(upper, lower, fy)

    def sample_footprint(self, chart: Tensor, u: Tensor, v: Tensor, footprint: Tensor) -> Tensor:
        """Trilinear value (M, C) for a sample that covers ``footprint`` metres (M,)."""
        level = torch.log2((footprint / self.spacing[chart]).clamp(min=1.0))
        level = torch.minimum(level, (self.levels[chart] - 1).to(level.dtype))
        low = level.long()
        high = torch.minimum(low + 1, self.levels[chart] - 1)
        blend = (level - low)[:, None]
        return torch.lerp(self.sample(chart, u, v, low), self.sample(chart, u, v, high), blend)


@dataclass(frozen=True)
class BakedRoom:
    """A room with textures and light, ready to be rendered.

    Attributes:
        spec: The room.
        texture: Colours, linear light, 3 channels.
        light: Irradiance (3 channels; a white matte surface shows it) and the visible share of each light.
        gloss, shininess, emission: (charts,).
        exposure: Factor on radiance before the tone curve, so that rooms come out equally bright.
    """

    spec: RoomSpec
    texture: Grid
    light: Grid
    gloss: Tensor
    shininess: Tensor
    emission: Tensor
    exposure: float


def bake(spec: RoomSpec) -> BakedRoom:
    """Paints all charts and computes the light; a second or two."""
    with one_thread(), torch.no_grad():
        texture = _paint(spec)
        light, brightness = _illuminate(spec, texture)
    return BakedRoom(
        spec=spec,
        texture=texture,
        light=light,
        gloss=torch.tensor([m.gloss for m in spec.materials], dtype=torch.float32),
        shininess=torch.tensor([m.shininess for m in spec.materials], dtype=torch.float32),
        emission=torch.tensor([m.emission for m in spec.materials], dtype=torch.float32),
        exposure=0.34 / brightness,
    )


def _charts(spec: RoomSpec) -> list[tuple[int, int]]:
    return [(p, face) for p in range(len(spec.primitives)) for face in range(CHARTS[int(spec.primitives.kind[p])])]


def _grid(levels: list[list[Tensor]], spacing: list[float]) -> Grid:
    """Joins per-chart lists of (rows, columns, C) levels."""
    count = len(levels)
    start = torch.zeros(count, MAX_LEVELS, dtype=torch.int64)
    columns, rows = torch.ones_like(start), torch.ones_like(start)
    flat, total = [], 0
    for c, pyramid in enumerate(levels):
        for k, image in enumerate(pyramid):
            rows[c, k], columns[c, k] = image.shape[:2]
            start[c, k] = total
            total += image.shape[0] * image.shape[1]
            flat.append(image.reshape(-1, image.shape[2]))
    depth = torch.tensor([len(pyramid) for pyramid in levels])
    return Grid(torch.cat(flat), start, columns, rows, depth, torch.tensor(spacing))


def _paint(spec: RoomSpec) -> Grid:
    pyramids, spacing = [], []
    for c, (p, face) in enumerate(_charts(spec)):
        width, height = chart_size(spec.primitives, p, face)
        columns, rows = max(math.ceil(width / TEXEL), 2), max(math.ceil(height / TEXEL), 2)
        canvas = Canvas(width, height, columns, rows, seed=(spec.seed * 1009 + c) % 2**32)
        image = torch.from_numpy(spec.materials[c].paint(canvas)).float().clamp(0, 1)
        pyramid = [image]
        while len(pyramid) < MAX_LEVELS and max(image.shape[:2]) > 1:
            image = _halved(image)
            pyramid.append(image)
        pyramids.append(pyramid)
        spacing.append(math.sqrt(width / columns * height / rows))
    return _grid(pyramids, spacing)


def _halved(image: Tensor) -> Tensor:
    """(rows, columns, C) averaged over 2 x 2; an odd last row or column is repeated."""
    if image.shape[0] % 2:
        image = torch.cat([image, image[-1:]])
    if image.shape[1] % 2:
        image = torch.cat([image, image[:, -1:]], dim=1)
    pairs = image[0::2] + image[1::2]
    return (pairs[:, 0::2] + pairs[:, 1::2]) * 0.25


def _illuminate(spec: RoomSpec, texture: Grid) -> tuple[Grid, float]:
    """The light grid and the mean radiance of the room's own walls and floor."""
    prims = spec.primitives
    points, normals, shapes, owner = [], [], [], []
    for c, (p, face) in enumerate(_charts(spec)):
        width, height = chart_size(prims, p, face)
        rows, columns = max(round(height / LUMEL), 2), max(round(width / LUMEL), 2)
        v, u = torch.meshgrid((torch.arange(rows) + 0.5) / rows, (torch.arange(columns) + 0.5) / columns, indexing="ij")
        at, facing = chart_points(prims, p, face, u.reshape(-1), v.reshape(-1))
        points.append(at)
        normals.append(facing)
        shapes.append((rows, columns))
        owner.append(torch.full((rows * columns,), c))
    position, normal, chart = torch.cat(points, 1), torch.cat(normals, 1), torch.cat(owner)
    position = position + normal * 2e-3

    direct, seen = _direct(spec, position, normal)
    gathered, hit_light, hit_weight, buried = _gather(spec, texture, position, normal, shapes)
    emission = torch.tensor([m.emission for m in spec.materials], dtype=torch.float32)
    mirrorless = (emission == 0).float()[:, None]
    bounced = torch.zeros_like(direct)
    for _ in range(BOUNCES):
        total = direct + bounced
        bounced = (total[hit_light] * gathered * hit_weight[..., None]).mean(dim=1)
    irradiance = (direct + bounced) * mirrorless[chart]
    values = torch.cat([irradiance, seen], dim=-1)
    fallback = torch.cat([_GAP_LIGHT * irradiance[~buried].mean(0), torch.zeros(seen.shape[1])])
    images, first = [], 0
    for rows, columns in shapes:
        count = rows * columns
        image = values[first : first + count].reshape(rows, columns, -1)
        images.append([_fill(image, buried[first : first + count].reshape(rows, columns), fallback)])
        first += count
    albedo = torch.stack([texture.data[texture.start[c, 0] : texture.start[c, 1]].mean(0) for c in range(6)])
    shell = [image[0][..., :3].mean(dim=(0, 1)) for image in images[:6]]
    area = [rows * columns for rows, columns in shapes[:6]]
    brightness = sum(float((s * a).mean()) * n for s, a, n in zip(shell, albedo, area, strict=True)) / sum(area)
    return _grid(images, [LUMEL] * len(images)), brightness


def _direct(spec: RoomSpec, position: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Irradiance / pi (M, 3) at points (3, M) from the lights, and the visible share of each light (M, L)."""
    count = position.shape[1]
    total, seen = torch.zeros(count, 3), torch.zeros(count, len(spec.lights))
    for k, light in enumerate(spec.lights):
        samples = _light_samples(light, LIGHT_SIDE)
        color = torch.tensor(light.color)
        for sample in samples:
            offset = sample[:, None] - position
            squared = dot(offset, offset).clamp(min=0.02)
            way = offset / squared.sqrt()
            cosine = dot(way, normal).clamp(min=0)
            leaving = torch.ones_like(cosine)
            if light.normal is not None:
                leaving = -dot(way, light.normal).clamp(max=0)
            free = torch.zeros(count)
            for part in (cosine * leaving > 0).nonzero()[:, 0].split(_CHUNK):
                free[part] = (~occluded(spec.primitives, position[:, part], sample)).float()
            total += (cosine * leaving * free / squared / math.pi / len(samples))[:, None] * color
            seen[:, k] += free / len(samples)
    return total, seen


def _light_samples(light: Light, side: int) -> Tensor:
    """(side * side, 3) points spread over a light; one point for a ball."""
    center = torch.tensor(light.center)
    if light.normal is None:
        return center[None]
    steps = (torch.arange(side) + 0.5) / side * 2 - 1
    u, v = torch.meshgrid(steps, steps, indexing="ij")
    edges = torch.tensor(light.edge_u), torch.tensor(light.edge_v)
    return center + u.reshape(-1, 1) * edges[0] + v.reshape(-1, 1) * edges[1]


def _gather(spec: RoomSpec, texture: Grid, position: Tensor, normal: Tensor, shapes: list[tuple[int, int]]):
    """What each point sees over its hemisphere, for the bounces.

    Returns:
        colours (M, R, 3) met by cosine-weighted rays, the light grid's cell there (M, R), the weight of
        each ray (0 from inside a solid) and whether the point is inside one (M,).
    """
    prims, count = spec.primitives, position.shape[1]
    steps = torch.arange(HEMISPHERE) + 0.5
    radius, angle = (steps / HEMISPHERE).sqrt(), steps * (math.pi * (3 - math.sqrt(5)))
    local = torch.stack([radius * angle.cos(), radius * angle.sin(), (1 - steps / HEMISPHERE).sqrt()])  # [3, R]
    upright = torch.tensor([[0.0], [0.0], [1.0]]).expand_as(normal)
    sideways = torch.tensor([[1.0], [0.0], [0.0]]).expand_as(normal)
    helper = torch.where(normal[2:].abs() > 0.9, sideways, upright)
    tangent = unit(torch.linalg.cross(helper, normal, dim=0))
    axes = (tangent, torch.linalg.cross(normal, tangent, dim=0), normal)
    rows = torch.tensor([s[0] for s in shapes])
    columns = torch.tensor([s[1] for s in shapes])
    starts = torch.cumsum(rows * columns, 0) - rows * columns
    color = torch.empty(count, HEMISPHERE, 3)
    cell = torch.empty(count, HEMISPHERE, dtype=torch.int64)
    weight = torch.ones(count, HEMISPHERE)
    buried_all = torch.zeros(count, dtype=torch.bool)
    per = max(_CHUNK // HEMISPHERE, 1)
    level = (texture.levels - 1).clamp(max=5)
    for first in range(0, count, per):
        span = slice(first, min(first + per, count))
        direction = sum(axis[:, span, None] * local[k] for k, axis in enumerate(axes)).reshape(3, -1)
        origin = position[:, span].repeat_interleave(HEMISPHERE, 1)
        t, index, buried = trace(prims, origin, direction)
        hits = surface(prims, origin + t * direction, index)
        color[span] = texture.sample(hits.chart, hits.u, hits.v, level[hits.chart]).reshape(-1, HEMISPHERE, 3)
        c = hits.chart
        i = torch.minimum((hits.u * columns[c]).long(), columns[c] - 1)
        j = torch.minimum((hits.v * rows[c]).long(), rows[c] - 1)
        cell[span] = (starts[c] + j * columns[c] + i).reshape(-1, HEMISPHERE)
        buried = buried.reshape(-1, HEMISPHERE).all(dim=1)
        buried_all[span] = buried
        weight[span] = (~buried).float()[:, None]
    return color, cell, weight, buried_all


def _fill(image: Tensor, buried: Tensor, fallback: Tensor) -> Tensor:
    """Gives points inside other solids the light of their neighbours, so that edges do not blend to black.

    Args:
        image: (rows, columns, C).
        buried: bool (rows, columns).
        fallback: (C,), for a chart that is inside other solids altogether.
    """
    if not bool(buried.any()):
        return image
    if bool(buried.all()):
        return fallback.expand_as(image)
    lit = (~buried).float()[None, None]
    values = image.permute(2, 0, 1)[None] * lit
    while not bool(lit.all()):
        total = torch.nn.functional.avg_pool2d(values, 3, 1, 1)
        share = torch.nn.functional.avg_pool2d(lit, 3, 1, 1)
        fresh = (lit == 0) & (share > 0)
        values = torch.where(fresh, total / share.clamp(min=1e-6), values)
        lit = torch.where(fresh, torch.ones_like(lit), lit)
    return values[0].permute(1, 2, 0)
