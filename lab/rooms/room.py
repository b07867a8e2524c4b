"""Synthetic rooms: what stands where along the walls and in the middle, under which lights."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from lab.rooms import furniture as fur
from lab.rooms import textures as tex
from lab.rooms.building import Builder, Light, LocalFrame, Material, Vec
from lab.rooms.furniture import Palette, hsv
from lab.rooms.light import BakedRoom, bake
from lab.rooms.raycast import Solids
from pointsplat_ns.errors import DataError


@dataclass(frozen=True)
class Room:
    """A synthetic room; its textures and light are computed when it is first rendered.

    Attributes:
        seed: what it was drawn from.
        size: width (x), depth (y) and height (z), metres; the floor's middle is the origin.
        solids: the room itself and all that is in it.
        materials: six for each solid, one for each face.
        lights: the windows and the lamp.
    """

    seed: int
    size: Vec
    solids: Solids
    materials: tuple[Material, ...]
    lights: tuple[Light, ...]

    @cached_property
    def baked(self) -> BakedRoom:
        """Textures and light; computing them takes some seconds."""
        return bake(self.solids, self.materials, self.lights, self.seed)


def make_room(seed: int) -> Room:
    """The room of a seed, 0 or more: its size, furniture, materials and lights. Raises DataError if
    the seed is negative.

    Example:
        >>> [round(metres, 1) for metres in make_room(3).size]
        [4.5, 4.3, 2.8]
    """
    if seed < 0:
        raise DataError(f"room seed {seed}: expected 0 or more")
    rng = np.random.default_rng([seed, 20])
    builder = Builder()
    width, depth, height = rng.uniform((3.8, 3.4, 2.4), (6.0, 5.0, 2.9)).tolist()
    _furnish(builder, Palette(rng), _Plan((width, depth, height), rng))
    return Room(
        seed,
        (width, depth, height),
        builder.solids(),
        tuple(builder.materials),
        tuple(builder.lights),
    )


@dataclass
class _Plan:
    """The walls of a room of a width, depth and height in metres, and what is taken of its
    space."""

    size: Vec
    rng: np.random.Generator
    taken: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)
    """Lower and upper corners of boxes."""

    def wall(self, number: int) -> tuple[LocalFrame, float]:
        """The middle of a wall's foot, facing into the room, and the wall's length."""
        x, y = ((0, -0.5), (0.5, 0), (0, 0.5), (-0.5, 0))[number]
        return LocalFrame(x * self.size[0], y * self.size[1], number), self.size[number % 2]

    def take(self, at: LocalFrame, size: Vec, low: float = 0.0) -> bool:
        """Take a box of a size that stands at a frame's origin, its foot at a height; False if it
        is not free."""
        ends = np.array(
            [at.point((x, y, low)) for x in (-size[0] / 2, size[0] / 2) for y in (0.02, size[1])]
        )
        lower = ends.min(0)
        upper = ends.max(0) + (0, 0, size[2])
        if any((lower < b + 0.05).all() and (a < upper + 0.05).all() for a, b in self.taken):
            return False
        self.taken.append((lower, upper))
        return True

    def spot(self, size: Vec, low: float = 0.0, tries: int = 60) -> LocalFrame | None:
        """Take space for something of a size at a random wall; None if none was free."""
        for _ in range(tries):
            at, length = self.wall(int(self.rng.integers(4)))
            at = at.moved(float(self.rng.uniform(-1, 1)) * (length - size[0] - 0.2) / 2, 0)
            if size[0] + 0.2 < length and self.take(at, size, low):
                return at
        return None


def _furnish(b: Builder, pal: Palette, plan: _Plan) -> None:
    """Build the shell of a room, windows, a door, furniture, pictures and a lamp."""
    rng = plan.rng
    height = plan.size[2]
    middle = LocalFrame(0, 0, 0)
    b.box(middle, (0, 0, height / 2), plan.size, Material(tex.plain(pal.wall, 0.07, 0.4)))
    darker = (0.78 * pal.wall[0], 0.78 * pal.wall[1], 0.78 * pal.wall[2])
    b.materials[int(rng.integers(4))] = Material(
        tex.stripes([pal.wall, darker], float(rng.uniform(0.08, 0.16)))
    )
    floor = Material(tex.wood(pal.timber, board=0.15), gloss=0.12, shininess=60.0)
    b.materials[4:6] = [floor, Material(tex.plain((0.8, 0.79, 0.76), 0.05, 0.6))]
    for at, length in map(plan.wall, range(4)):
        b.box(at, (0, 0.008, 0.05), (length - 0.02, 0.016, 0.1), pal.white)  # skirting
    glow = Material(tex.plain((1.0, 0.92, 0.78), 0.02), emission=1.6)
    rim = Material(tex.plain((0.25, 0.24, 0.22)))
    b.box(middle, (0, 0, height - 0.03), (0.5, 0.5, 0.06), rim, opaque=False)
    b.box(middle, (0, 0, height - 0.07), (0.44, 0.44, 0.04), glow, opaque=False)
    b.lights.append(
        Light((0, 0, height - 0.1), (0.2, 0, 0), (0, 0.2, 0), (0, 0, -1), (2.0, 1.75, 1.35))
    )

    for _ in range(1 + int(rng.integers(2))):
        w = float(rng.uniform(1.1, 1.8))
        if spot := plan.spot((w + 0.6, 0.2, height - 0.9), low=0.9):
            _window(b, spot, pal, w)
    if spot := plan.spot((1.0, 0.9, 2.05)):
        b.box(spot, (0, 0.02, 1.0), (0.9, 0.04, 2.0), pal.wood)
        b.box(spot, (0.38, 0.06, 1.0), (0.12, 0.06, 0.04), pal.metal, round=True)
    _middle(b, pal, plan)
    # Width, depth and height of a piece, and the height to leave free above it, metres.
    pieces: list[tuple[Callable[[Builder, LocalFrame, Palette, Vec], None], Vec, float]] = [
        (fur.sofa, (1.9, 0.88, 0.8), 0.0),
        (fur.television, (1.4, 0.4, 0.45), 0.7)
        if rng.random() < 0.5
        else (fur.wardrobe, (1.1, 0.55, 2.0), 0.0),
        (fur.dresser, (1.0, 0.45, 0.8), 0.2),
        (fur.bookshelf, (1.0, 0.3, 1.9), 0.0),
        (fur.plant, (0.6, 0.6, 1.5), 0.0),
        (fur.bookshelf, (0.8, 0.3, 1.5), 0.0),
    ]
    for build, usual, above in pieces:
        w, d, h = (float(value * rng.uniform(0.92, 1.1)) for value in usual)
        if spot := plan.spot((w, d, h + above)):
            build(b, spot.moved(0, 0.025), pal, (w, d, h))
    for _ in range(8):
        w, h, low = (
            float(rng.uniform(*bounds)) for bounds in ((0.45, 0.95), (0.4, 0.75), (1.05, 1.4))
        )
        if spot := plan.spot((w, 0.05, h), low, tries=4):
            art = Material(tex.picture([*pal.accents, pal.pale]), gloss=0.08)
            b.box(spot, (0, 0.015, low + h / 2), (w, 0.03, h), pal.wood, front=art)


def _window(b: Builder, at: LocalFrame, pal: Palette, width: float) -> None:
    """A window of a width, 1.25 m high, with a sill and curtains."""
    height = 1.25
    z = 0.95 + 1.25 / 2
    panes = Material(
        tex.window(hsv(0.57, 0.45, 0.9), hsv(0.28, 0.45, 0.55), 2 if width < 1.5 else 3),
        emission=1.7,
    )
    b.box(at, (0, 0.01, z), (width, 0.02, height), pal.white, front=panes, opaque=False)
    b.box(at, (0, 0.08, 0.93), (width + 0.2, 0.16, 0.04), pal.white)
    curtain = Material(tex.stripes([pal.accent(), pal.pale], 0.09))
    for side in (-1, 1):
        b.box(at, (side * (width / 2 + 0.16), 0.09, z - 0.02), (0.3, 0.06, height + 0.2), curtain)
    b.box(at, (0, 0.1, z + height / 2 + 0.1), (width + 0.7, 0.03, 0.03), pal.metal)
    edge = at.vector((width / 2, 0, 0))
    area = width * height
    color = (1.5 * area, 1.62 * area, 1.8 * area)
    b.lights.append(
        Light(at.point((0, 0.03, z)), edge, (0, 0, height / 2), at.vector((0, 1, 0)), color)
    )


def _middle(b: Builder, pal: Palette, plan: _Plan) -> None:
    """The rug, and on it a table with chairs, a low table or nothing."""
    rng = plan.rng
    (width, depth, _) = plan.size
    at = LocalFrame(float(rng.uniform(-0.25, 0.25)), float(rng.uniform(-0.2, 0.2)), 0)
    rug = (float(rng.uniform(0.35, 0.45)) * width, float(rng.uniform(0.35, 0.45)) * depth, 0.012)
    b.box(at, (0, 0, 0.006), rug, Material(tex.rug([pal.accent(), pal.pale, pal.accents[3]])))
    kind = int(rng.integers(3))
    if kind == 0:
        fur.table(b, at, pal, (1.3, 0.8, 0.74))
        for x, y in ((-0.36, -0.52), (0.36, -0.52), (-0.36, 0.52), (0.36, 0.52)):
            fur.chair(b, at.moved(x, y, 0 if y < 0 else 2), pal)
        plan.take(at.moved(0, -0.8), (1.4, 1.6, 1.0))
    elif kind == 1:
        fur.table(b, at, pal, (1.0, 0.55, 0.42))
        plan.take(at.moved(0, -0.4), (1.1, 0.8, 0.8))
