"""Sampled rooms: which furniture stands where, of what material, under which lights."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.rooms import textures as tex
from pointsplat_ns.rooms.raycast import BOX, CHARTS, CYLINDER, ELLIPSOID, Primitives

Vec = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """How a surface looks.

    Attributes:
        paint: Its colour, linear light.
        gloss: Strength of the highlight, 0 for a matte surface.
        shininess: Blinn-Phong exponent.
        emission: Radiance of a shining surface as a multiple of ``paint``; 0 for the others.
    """

    paint: tex.Painter
    gloss: float = 0.0
    shininess: float = 30.0
    emission: float = 0.0


@dataclass(frozen=True)
class Light:
    """A rectangle that shines on the side of its normal, or a ball's middle that shines all around.

    Attributes:
        center, edge_u, edge_v: Middle and half edges, world (edges are zero for a point).
        normal: Unit vector, or None for a point.
        color: Radiance times area (RGB).
    """

    center: Vec
    edge_u: Vec
    edge_v: Vec
    normal: Vec | None
    color: Vec


@dataclass(frozen=True)
class RoomSpec:
    """What a seed decided about a room.

    Attributes:
        seed: The seed.
        kind: "living", "bedroom", "study" or "dining".
        size: Width (x), depth (y) and height (z) in metres.
        primitives: All solids; number 0 is the room itself.
        materials: One material per chart of each solid, in order.
        lights: The light sources.
    """

    seed: int
    kind: str
    size: Vec
    primitives: Primitives
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]


@dataclass
class Frame:
    """A place to build at: origin on the floor and rotation about z."""

    x: float
    y: float
    yaw: float

    def point(self, p: Vec) -> Vec:
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return (self.x + cos * p[0] - sin * p[1], self.y + sin * p[0] + cos * p[1], p[2])


@dataclass
class Builder:
    """Collects solids in the frames that furniture is built in."""

    rows: list[tuple] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)

    def add(
        self,
        kind: int,
        at: Frame,
        center: Vec,
        half: Vec,
        material: Material | dict[int, Material],
        turn: float = 0.0,
        opaque: bool = True,
    ) -> None:
        """One solid; ``material`` may be a dict from face to material, with -1 for the other faces."""
        self.rows.append((kind, at.point(center), half, at.yaw + turn, opaque))
        for face in range(CHARTS[kind]):
            chosen = material.get(face, material.get(-1)) if isinstance(material, dict) else material
            self.materials.append(chosen)

    def box(self, at: Frame, center: Vec, size: Vec, material, turn: float = 0.0, opaque: bool = True) -> None:
        """A box of full extents ``size`` whose middle is ``center``."""
        self.add(BOX, at, center, (size[0] / 2, size[1] / 2, size[2] / 2), material, turn, opaque)

    def tube(self, at: Frame, foot: Vec, radius: float, height: float, material, opaque: bool = True) -> None:
        """An upright cylinder standing on ``foot``."""
        center = (foot[0], foot[1], foot[2] + height / 2)
        self.add(CYLINDER, at, center, (radius, radius, height / 2), material, opaque=opaque)

    def ball(self, at: Frame, center: Vec, half: Vec, material, turn: float = 0.0, opaque: bool = True) -> None:
        """An ellipsoid with half axes ``half``."""
        self.add(ELLIPSOID, at, center, half, material, turn, opaque)

    def primitives(self) -> Primitives:
        kind, center, half, yaw, opaque = zip(*self.rows, strict=True)
        return Primitives(
            kind=torch.tensor(kind),
            center=torch.tensor(center, dtype=torch.float32),
            half=torch.tensor(half, dtype=torch.float32),
            yaw=torch.tensor(yaw, dtype=torch.float32),
            opaque=torch.tensor(opaque),
        )


def hsv(hue: float, saturation: float, value: float) -> tex.Color:
    """Linear-light colour of hue, saturation and value in [0, 1]."""
    import colorsys

    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return (r**2.2, g**2.2, b**2.2)


class Palette:
    """The colours and materials of one room, drawn once so that its pieces belong together."""

    def __init__(self, rng: np.random.Generator):
        hue = rng.random()
        self.rng = rng
        self.accents = [hsv(hue + d + rng.uniform(-0.04, 0.04), rng.uniform(0.5, 0.85), rng.uniform(0.45, 0.85))
                        for d in (0.0, 0.08, 0.33, 0.55, 0.5)]  # fmt: skip
        self.wall = hsv(rng.random(), rng.uniform(0.05, 0.28), rng.uniform(0.78, 0.92))
        self.wood_tone = hsv(rng.uniform(0.05, 0.1), rng.uniform(0.4, 0.65), rng.uniform(0.5, 0.85))
        self.dark_wood = hsv(rng.uniform(0.03, 0.08), rng.uniform(0.5, 0.7), rng.uniform(0.32, 0.5))
        self.pale = hsv(rng.uniform(0.05, 0.15), 0.08, 0.9)

    def accent(self) -> tex.Color:
        return self.accents[self.rng.integers(len(self.accents))]

    def wood(self) -> Material:
        tone = self.wood_tone if self.rng.random() < 0.6 else self.dark_wood
        return Material(tex.wood(tone), gloss=self.rng.uniform(0.04, 0.12), shininess=self.rng.uniform(30, 80))

    def cloth(self) -> Material:
        check = self.rng.choice([0.0, 0.0, 0.14, 0.2])
        return Material(tex.fabric(self.accent(), self.accent(), float(check)))

    def lacquer(self) -> Material:
        return Material(tex.plain(self.accent(), 0.15, 0.12), gloss=0.35, shininess=float(self.rng.uniform(40, 110)))

    def metal(self) -> Material:
        return Material(tex.plain((0.3, 0.3, 0.32), 0.1), gloss=0.5, shininess=60.0)

    def floor(self) -> Material:
        style = self.rng.integers(4)
        if style == 0:
            a, b = hsv(0.1, 0.12, 0.85), hsv(self.rng.random(), 0.3, 0.5)
            return Material(tex.tiles(a, b, float(self.rng.uniform(0.28, 0.45))), gloss=0.16, shininess=90.0)
        if style == 1:
            tone = hsv(self.rng.random(), 0.2, 0.62)
            return Material(tex.fabric(tone, self.accent(), 0.5))
        tone = self.wood_tone if style == 2 else self.dark_wood
        board = float(self.rng.uniform(0.1, 0.2))
        return Material(tex.wood(tone, board=board), gloss=0.12, shininess=float(self.rng.uniform(40, 90)))

    def wall_material(self) -> Material:
        style = self.rng.integers(5)
        if style == 0:
            return Material(tex.bricks(hsv(self.rng.uniform(0.0, 0.07), 0.5, 0.66)))
        if style == 1:
            other = tuple(0.78 * v for v in self.wall)
            return Material(tex.stripes([self.wall, other], float(self.rng.uniform(0.08, 0.16))))
        if style == 2:
            motif = tuple(float(m) for m in 0.5 * np.asarray(self.wall) + 0.5 * np.asarray(self.accent()))
            return Material(tex.wallpaper(self.wall, motif, float(self.rng.uniform(0.25, 0.4))))
        return Material(tex.plain(self.wall, 0.07, 0.4))


def sample_room(seed: int) -> RoomSpec:
    """Draws a furnished room; the same seed gives the same room."""
    from pointsplat_ns.rooms.furniture import furnish

    rng = np.random.default_rng([seed, 20])
    kind = ("living", "bedroom", "study", "dining")[seed % 4]
    size = (float(rng.uniform(3.8, 6.0)), float(rng.uniform(3.4, 5.0)), float(rng.uniform(2.4, 2.9)))
    builder, palette = Builder(), Palette(rng)
    lights = furnish(builder, palette, kind, size, rng)
    return RoomSpec(seed, kind, size, builder.primitives(), tuple(builder.materials), tuple(lights))


def light_samples(light: Light, side: int) -> Tensor:
    """(side * side, 3) points spread over a light; one point for a ball."""
    center = torch.tensor(light.center)
    if light.normal is None:
        return center[None]
    steps = (torch.arange(side) + 0.5) / side * 2 - 1
    u, v = torch.meshgrid(steps, steps, indexing="ij")
    edges = torch.tensor(light.edge_u), torch.tensor(light.edge_v)
    return center + u.reshape(-1, 1) * edges[0] + v.reshape(-1, 1) * edges[1]
