"""The parts of a room: solids with materials, and lights."""

import math
from dataclasses import dataclass, field

import torch

from pointsplat_ns.rooms.raycast import BOX, CHARTS, CYLINDER, ELLIPSOID, Primitives
from pointsplat_ns.rooms.textures import Painter

Vec = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """How a surface looks.

    Attributes:
        paint: Its colour, linear light.
        gloss: Strength of the highlight, 0 for a matte surface.
        shininess: Blinn-Phong exponent.
        emission: Radiance of a light-emitting surface as a multiple of ``paint``; 0 for the others.
    """

    paint: Painter
    gloss: float = 0.0
    shininess: float = 30.0
    emission: float = 0.0


Surfaces = Material | dict[int, Material]
"""One material for a whole solid, or one for each face by its number, -1 standing for the other faces."""


@dataclass(frozen=True)
class Light:
    """A rectangle that emits light on the side of its normal, or a point that emits in all directions.

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
    """The description of a room, drawn from a seed.

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
    """The local frame of a piece of furniture: origin on the floor and rotation about z."""

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
        material: Surfaces,
        turn: float = 0.0,
        opaque: bool = True,
    ) -> None:
        """One solid, of half extents ``half`` along its own axes, turned about z by ``turn`` radians."""
        self.rows.append((kind, at.point(center), half, at.yaw + turn, opaque))
        for face in range(CHARTS[kind]):
            if isinstance(material, dict):
                self.materials.append(material[face if face in material else -1])
            else:
                self.materials.append(material)

    def box(
        self, at: Frame, center: Vec, size: Vec, material: Surfaces, turn: float = 0.0, opaque: bool = True
    ) -> None:
        """A box of full extents ``size`` whose middle is ``center``."""
        self.add(BOX, at, center, (size[0] / 2, size[1] / 2, size[2] / 2), material, turn, opaque)

    def tube(self, at: Frame, foot: Vec, radius: float, height: float, material: Surfaces, opaque: bool = True) -> None:
        """An upright cylinder standing on ``foot``."""
        center = (foot[0], foot[1], foot[2] + height / 2)
        self.add(CYLINDER, at, center, (radius, radius, height / 2), material, opaque=opaque)

    def ball(
        self, at: Frame, center: Vec, half: Vec, material: Surfaces, turn: float = 0.0, opaque: bool = True
    ) -> None:
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
