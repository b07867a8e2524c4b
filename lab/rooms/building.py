"""The parts of a room: solids with materials, and lights."""

from dataclasses import dataclass, field

import torch

from lab.rooms.raycast import Solids
from lab.rooms.textures import Painter

Vec = tuple[float, float, float]


@dataclass(frozen=True)
class Material:
    """Appearance of a surface."""

    paint: Painter  # its colour, linear light
    gloss: float = 0.0  # strength of the highlight, 0 for a matte surface
    shininess: float = 50.0  # Blinn-Phong exponent
    emission: float = (
        0.0  # radiance of a light-emitting surface as a multiple of its colour; 0 for the others
    )


@dataclass(frozen=True)
class Light:
    """A rectangle that emits light on the side of its normal."""

    center: Vec
    edge_u: Vec  # half an edge, world
    edge_v: Vec
    normal: Vec  # unit vector
    color: Vec  # radiance times area (RGB)


@dataclass(frozen=True)
class LocalFrame:
    """Coordinates of a piece of furniture: origin (x, y) on the floor, turned about z by quarter
    turns."""

    x: float
    y: float
    quarters: int

    def vector(self, v: Vec) -> Vec:
        """The world's vector of one in the frame."""
        x, y, z = v
        return ((x, y, z), (-y, x, z), (-x, -y, z), (y, -x, z))[self.quarters % 4]

    def point(self, p: Vec) -> Vec:
        """The world's point of one in the frame."""
        x, y, z = self.vector(p)
        return self.x + x, self.y + y, z

    def moved(self, x: float, y: float, quarters: int = 0) -> "LocalFrame":
        """A frame whose origin is (x, y) in this one, turned further by so many quarters."""
        x, y, _ = self.point((x, y, 0))
        return LocalFrame(x, y, self.quarters + quarters)


@dataclass
class Builder:
    """Collects solids, the materials of their six faces, and lights."""

    rows: list[tuple[Vec, Vec, bool, bool]] = field(default_factory=list)
    materials: list[Material] = field(default_factory=list)
    lights: list[Light] = field(default_factory=list)

    def box(
        self,
        at: LocalFrame,
        center: Vec,
        size: Vec,
        material: Material,
        front: Material | None = None,
        round: bool = False,
        opaque: bool = True,
    ) -> None:
        """A box, or the ellipsoid that fits in it, of full extents ``size`` in the frame. ``front``
        is the material of the face in the frame's direction of +y, if it differs; what is not
        ``opaque`` casts no shadow."""
        x, y, z = at.vector(size)
        self.rows.append((at.point(center), (abs(x) / 2, abs(y) / 2, z / 2), round, opaque))
        faces = [material] * 6
        faces[(3, 0, 2, 1)[at.quarters % 4]] = front or material
        self.materials += faces

    def solids(self) -> Solids:
        """All that were added."""
        center, half, round, opaque = map(torch.tensor, zip(*self.rows, strict=True))
        return Solids(center, half, round, opaque)
