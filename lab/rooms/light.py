"""Textures and light of a room, computed once and looked up by every render.

Colours are mip-mapped grids of texels, one for each chart. Light that does not depend on the viewer
(direct light with soft shadows, and ambient light with ambient occlusion) is a coarser grid,
together with the visible share of each light, which highlights need.
"""

import math
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from lab.rooms.building import Light, Material
from lab.rooms.raycast import Solids, chart_points, chart_size, dot, occluded, trace, unit
from lab.rooms.textures import Canvas
from pointsplat_ns.system.tensors import FLOATS, INDICES
from pointsplat_ns.system.threads import one_thread


@dataclass(frozen=True)
class LightSettings:
    """Resolutions of what is stored of surfaces, metres."""

    texel: float = 0.0075
    """Distance of texels: a pixel of a 320 x 240 picture with 78 degrees covers that at 1.5 m."""
    lumel: float = 0.12
    """Distance of points where light is computed."""


LIGHT = LightSettings()


@dataclass(frozen=True)
class ChartGrids:
    """Grids of values on all charts, one after the other, in several levels, each of half the last
    one's resolution.

    Attributes:
        data: (T, C) values; chart c at level l starts at ``start[c, l]``, in rows of ``columns[c,
            l]``.
        start, columns, rows: int64 (charts, levels).
        spacing: (charts,), metres between points of level 0.
    """

    data: Tensor
    start: Tensor
    columns: Tensor
    rows: Tensor
    spacing: Tensor

    @classmethod
    def of(cls, images: list[Tensor], spacing: list[float], levels: int) -> "ChartGrids":
        """The grids of images (C, rows, columns), one for each chart, halved until there are so
        many levels."""
        pyramids = []
        for image in images:
            pyramids.append([image])
            for _ in range(levels - 1):
                image = F.adaptive_avg_pool2d(
                    image, (max(1, image.shape[1] // 2), max(1, image.shape[2] // 2))
                )
                pyramids[-1].append(image)
        shapes = torch.tensor(
            [[image.shape[1:] for image in pyramid] for pyramid in pyramids], **INDICES
        )
        counts = shapes.prod(-1).reshape(-1)
        data = torch.cat([image.flatten(1).T for pyramid in pyramids for image in pyramid])
        start = (counts.cumsum(0) - counts).view(len(images), levels)
        return cls(data, start, shapes[..., 1], shapes[..., 0], torch.tensor(spacing, **FLOATS))

    def sample(self, chart: Tensor, u: Tensor, v: Tensor, footprint: Tensor) -> Tensor:
        """Value (M, C) of samples that cover ``footprint`` metres (M,): bilinear, in the level
        nearest to that; clamped at the charts' borders."""
        level = (
            torch.log2(footprint / self.spacing[chart])
            .round()
            .clamp(0, self.start.shape[1] - 1)
            .long()
        )
        start = self.start[chart, level]
        columns = self.columns[chart, level]
        rows = self.rows[chart, level]
        x = (u * columns - 0.5).clamp(min=0)
        y = (v * rows - 0.5).clamp(min=0)
        i = x.long()
        j = y.long()
        corner = start + j * columns + i
        right = (i + 1 < columns).long()
        below = torch.where(j + 1 < rows, columns, 0)
        upper, lower = (
            torch.lerp(self.data[at], self.data[at + right], (x - i)[:, None])
            for at in (corner, corner + below)
        )
        return torch.lerp(upper, lower, (y - j)[:, None])


@dataclass(frozen=True)
class BakedRoom:
    """A room with textures and light, ready to be rendered.

    Attributes:
        texture: colours, linear light, 3 channels.
        light: irradiance / pi (3 channels; a white matte surface shows it) and the visible share of
            each light.
        gloss, shininess, emission: (charts,).
        exposure: factor on radiance before the tone curve, so that rooms come out equally bright.
    """

    texture: ChartGrids
    light: ChartGrids
    gloss: Tensor
    shininess: Tensor
    emission: Tensor
    exposure: float


def bake(
    solids: Solids, materials: tuple[Material, ...], lights: tuple[Light, ...], seed: int
) -> BakedRoom:
    """Paint all charts and compute their light; a second or two."""
    with one_thread(), torch.no_grad():
        texture = _paint(solids, materials, seed)
        light = _illuminate(solids, lights)
    shell = light.start[6, 0]
    albedo = texture.data[: texture.start[0, 1]].mean()
    gloss, shininess, emission = (
        torch.tensor([getattr(material, name) for material in materials], **FLOATS)
        for name in ("gloss", "shininess", "emission")
    )
    return BakedRoom(
        texture,
        light,
        gloss,
        shininess,
        emission,
        float(0.34 / (light.data[:shell, :3].mean() * albedo)),
    )


def _paint(solids: Solids, materials: tuple[Material, ...], seed: int) -> ChartGrids:
    images = []
    spacing = []
    for chart, material in enumerate(materials):
        width, height = chart_size(solids, chart)
        columns = max(math.ceil(width / LIGHT.texel), 2)
        rows = max(math.ceil(height / LIGHT.texel), 2)
        painted = material.paint(Canvas(width, height, columns, rows, seed * 1009 + chart))
        images.append(torch.from_numpy(painted).float().clamp(0, 1).permute(2, 0, 1))
        spacing.append(math.sqrt(width / columns * height / rows))
    return ChartGrids.of(images, spacing, levels=8)


def _illuminate(solids: Solids, lights: tuple[Light, ...]) -> ChartGrids:
    """The light of all charts."""
    shapes = []
    placed = []
    for chart in range(6 * len(solids)):
        width, height = chart_size(solids, chart)
        rows = max(round(height / LIGHT.lumel), 2)
        columns = max(round(width / LIGHT.lumel), 2)
        v, u = ((torch.arange(count, **FLOATS) + 0.5) / count for count in (rows, columns))
        v, u = torch.meshgrid(v, u, indexing="ij")
        shapes.append((rows, columns))
        placed.append(chart_points(solids, chart, u.reshape(-1), v.reshape(-1)))
    points, normals = (torch.cat(parts, 1) for parts in zip(*placed, strict=True))
    points = points + normals * 2e-3  # off the surface
    direct, visible = zip(
        *(_direct(solids, light, points, normals) for light in lights), strict=True
    )
    total = torch.stack(direct).sum(0)
    shell = sum(rows * columns for rows, columns in shapes[:6])
    # Surfaces that reflect half of their light add as much again, in equal parts from everywhere.
    ambient = _openness(solids, points, normals)[:, None] * total[:shell].mean(0)
    values = torch.cat([total + ambient, torch.stack(visible, 1)], 1)
    parts = values.split([rows * columns for rows, columns in shapes])
    images = [part.T.reshape(-1, *shape) for part, shape in zip(parts, shapes, strict=True)]
    return ChartGrids.of(images, [LIGHT.lumel] * len(images), levels=1)


def _direct(solids: Solids, light: Light, points: Tensor, normals: Tensor) -> tuple[Tensor, Tensor]:
    """Irradiance / pi (M, 3) at points (3, M) from a light, and its visible share (M,), by 4 x 4
    samples of it."""
    center, edge_u, edge_v, color = map(
        torch.tensor, (light.center, light.edge_u, light.edge_v, light.color)
    )
    strength = torch.zeros(points.shape[1], **FLOATS)
    visible = torch.zeros(points.shape[1], **FLOATS)
    for a in (-0.75, -0.25, 0.25, 0.75):
        for b in (-0.75, -0.25, 0.25, 0.75):
            sample = center + a * edge_u + b * edge_v
            offset = sample[:, None] - points
            squared = dot(offset, offset).clamp(min=0.02)
            way = offset / squared.sqrt()
            arriving = dot(way, normals).clamp(min=0) * -dot(way, light.normal).clamp(max=0)
            for part in (
                (arriving > 0).nonzero()[:, 0].split(1 << 15)
            ):  # temporaries stay in the cache
                free = (~occluded(solids, points[:, part], sample)).float() / 16
                visible[part] += free
                strength[part] += arriving[part] * free / squared[part] / math.pi
    return strength[:, None] * color, visible


def _openness(solids: Solids, points: Tensor, normals: Tensor) -> Tensor:
    """Share (M,) of ambient light that arrives at points (3, M): all where the hemisphere is free
    for 1 m, 0.4 in gaps and inside of solids."""
    count = 24
    steps = torch.arange(count, **FLOATS) + 0.5
    angle = steps * (math.pi * (3 - math.sqrt(5)))
    up = 1 - 2 * steps / count
    radius = (1 - up * up).sqrt()
    sphere = torch.stack([radius * angle.cos(), radius * angle.sin(), up])[
        :, None
    ]  # evenly over a sphere
    open_share = torch.empty(points.shape[1], **FLOATS)
    for part in torch.arange(points.shape[1], **INDICES).split((1 << 15) // count):
        # The normal plus a point of the unit sphere: distributed by the cosine.
        ways = unit(normals[:, part, None] + sphere).reshape(3, -1)
        distance, _ = trace(solids, points[:, part].repeat_interleave(count, 1), ways)
        open_share[part] = distance.view(-1, count).clamp(max=1.0).mean(1)
    return open_share.clamp(min=0.4)
