"""Sampled rooms: which furniture stands where along the walls and in the middle, under which lights."""

import math
from collections.abc import Callable

import numpy as np

from pointsplat_ns.rooms import textures as tex
from pointsplat_ns.rooms.building import Builder, Frame, Light, Material, RoomSpec, Vec
from pointsplat_ns.rooms.furniture import (
    bed,
    bookshelf,
    chair,
    desk,
    dresser,
    floor_lamp,
    plant,
    sofa,
    table,
    tv_bench,
    wardrobe,
)
from pointsplat_ns.rooms.palette import Palette, hsv

GAP = 0.06  # metres left between neighbouring pieces
DOOR, WINDOW = 0.0, 0.85  # metres of wall free below an opening; no piece of furniture has these heights
OPENINGS = (DOOR, WINDOW)

Wall = tuple[Frame, float]
"""The middle of a wall's foot, and its length in metres."""
Taken = list[tuple[float, float, float]]
"""Occupied parts of a wall: from, to, and the height from which (for an opening: up to which) it is free, metres."""
Floor = list[tuple[float, float, float, float]]
"""Rectangles of the floor that are taken: x0, x1, y0, y1 in metres."""

Piece = Callable[[Builder, Frame, Palette, Vec], Light | None]
"""Builds a piece of furniture of a width, depth and height; returns the light if it is a lamp."""

SIZES: dict[Piece, Vec] = {
    bed: (1.5, 2.0, 0.95),
    plant: (0.62, 0.62, 1.5),
    floor_lamp: (0.4, 0.4, 1.65),
    bookshelf: (1.0, 0.3, 1.9),
    wardrobe: (1.1, 0.55, 2.0),
    dresser: (1.0, 0.45, 0.8),
    tv_bench: (1.4, 0.4, 0.45),
    desk: (1.3, 0.65, 0.74),
    sofa: (1.9, 0.88, 0.8),
}
"""Usual width, depth and height in metres."""

ROOMS: dict[str, list[Piece]] = {
    "living": [sofa, tv_bench, bookshelf, floor_lamp, plant, dresser],
    "bedroom": [bed, wardrobe, dresser, floor_lamp, bookshelf, plant],
    "study": [desk, bookshelf, bookshelf, sofa, plant, floor_lamp, dresser],
    "dining": [dresser, bookshelf, plant, tv_bench, floor_lamp, wardrobe],
}
"""Furniture along the walls of each kind of room, placed in this order as far as there is space."""


def sample_room(seed: int) -> RoomSpec:
    """Draws a furnished room; the same seed gives the same room."""
    rng = np.random.default_rng([seed, 20])
    kind = ("living", "bedroom", "study", "dining")[seed % 4]
    size = (float(rng.uniform(3.8, 6.0)), float(rng.uniform(3.4, 5.0)), float(rng.uniform(2.4, 2.9)))
    builder, palette = Builder(), Palette(rng)
    lights = furnish(builder, palette, kind, size, rng)
    return RoomSpec(seed, kind, size, builder.primitives(), tuple(builder.materials), tuple(lights))


def furnish(b: Builder, pal: Palette, kind: str, size: Vec, rng: np.random.Generator) -> list[Light]:
    """Builds the shell, openings, wall furniture, middle group and wall pictures; returns the lights."""
    width, depth, height = size
    room = Frame(0, 0, 0)
    wall, other = pal.wall_material(), Material(tex.plain(pal.wall, 0.07, 0.4))
    ceiling = Material(tex.plain((0.8, 0.79, 0.76), 0.05, 0.6))
    accent_wall = int(rng.integers(4))
    shell = {face: wall if face == accent_wall or rng.random() < 0.35 else other for face in range(4)}
    b.box(room, (0, 0, height / 2), size, {**shell, 4: pal.floor(), 5: ceiling})
    skirting = Material(tex.plain(pal.pale), gloss=0.05)
    for wall_at, length in _walls(width, depth):
        b.box(wall_at, (0, 0.008, 0.05), (length - 0.02, 0.016, 0.1), skirting)
    lights = []
    walls = _walls(width, depth)
    taken: list[Taken] = [[], [], [], []]
    floor: Floor = []

    first = int(rng.integers(4))
    for number, k in enumerate((first, (first + 1 + int(rng.integers(3))) % 4)):
        at, length = walls[k]
        if number == 0 or rng.random() < 0.6:
            lights.append(_window(b, at, length, height, pal, taken[k]))
    k = (first + 2) % 4
    at, length = walls[k]
    x = float(rng.choice([-1, 1])) * (length / 2 - 0.65)
    if not _blocked(taken[k], x - 0.5, x + 0.5, 0.0):
        b.box(at, (x, 0.025, 1.0), (0.9, 0.05, 2.0), {-1: pal.wood(), 3: Material(tex.door(pal.wood_tone), 0.08, 50.0)})
        taken[k].append((x - 0.5, x + 0.5, DOOR))
        cx, cy, _ = at.point((x, 0.5, 0))
        floor.append((cx - 0.5, cx + 0.5, cy - 0.5, cy + 0.5))

    _middle(b, pal, kind, size, rng, floor)
    for piece in ROOMS[kind]:
        light = _against_wall(b, pal, piece, walls, taken, floor, rng)
        if light is not None:
            lights.append(light)
    _pictures(b, pal, walls, taken, height, rng)
    lights.append(_ceiling_lamp(b, room, height))
    return lights


def _walls(width: float, depth: float) -> list[Wall]:
    return [
        (Frame(0, -depth / 2, 0.0), width),
        (Frame(width / 2, 0, math.pi / 2), depth),
        (Frame(0, depth / 2, math.pi), width),
        (Frame(-width / 2, 0, -math.pi / 2), depth),
    ]


def _blocked(taken: Taken, x0: float, x1: float, top: float) -> bool:
    return any(x0 < b and a < x1 and top > free for a, b, free in taken)


def _window(b: Builder, at: Frame, length: float, height: float, pal: Palette, taken: Taken) -> Light:
    w = float(pal.rng.uniform(1.1, min(2.0, length - 1.6)))
    h, sill = 1.25, 0.95
    x = float(pal.rng.uniform(-1, 1)) * (length - w - 1.2) / 2
    z = sill + h / 2
    panes = Material(tex.window(hsv(0.57, 0.45, 0.9), hsv(0.28, 0.45, 0.55), (2 if w < 1.5 else 3, 2)), emission=1.7)
    white = Material(tex.plain(pal.pale), gloss=0.1)
    b.box(at, (x, 0.01, z), (w, 0.02, h), {-1: white, 3: panes}, opaque=False)
    b.box(at, (x, 0.08, sill - 0.02), (w + 0.2, 0.16, 0.04), white)
    curtain = Material(tex.stripes([pal.accent(), pal.pale, pal.accent()], 0.09))
    for s in (-1, 1):
        b.box(at, (x + s * (w / 2 + 0.16), 0.09, z - 0.05), (0.3, 0.06, h + 0.3), curtain)
    b.box(at, (x, 0.1, sill + h + 0.14), (w + 0.8, 0.03, 0.03), pal.metal())
    taken.append((x - w / 2 - 0.35, x + w / 2 + 0.35, WINDOW))
    into = at.point((0, 1, 0))
    normal = (into[0] - at.x, into[1] - at.y, 0.0)
    along = at.point((1, 0, 0))
    edge = ((along[0] - at.x) * w / 2, (along[1] - at.y) * w / 2, 0.0)
    area = w * h
    return Light(at.point((x, 0.03, z)), edge, (0, 0, h / 2), normal, (1.5 * area, 1.62 * area, 1.8 * area))


def _ceiling_lamp(b: Builder, at: Frame, height: float) -> Light:
    glow = Material(tex.plain((1.0, 0.92, 0.78), 0.02), emission=1.6)
    rim = Material(tex.plain((0.25, 0.24, 0.22)), gloss=0.3)
    b.tube(at, (0, 0, height - 0.09), 0.26, 0.07, {-1: rim, 1: glow}, opaque=False)
    return Light((0, 0, height - 0.1), (0.2, 0, 0), (0, 0.2, 0), (0, 0, -1), (2.0, 1.75, 1.35))


def _middle(b: Builder, pal: Palette, kind: str, size: Vec, rng: np.random.Generator, floor: Floor) -> None:
    """The rug and, except in bedrooms, the table in the middle."""
    width, depth, _ = size
    cx, cy = float(rng.uniform(-0.25, 0.25)), float(rng.uniform(-0.2, 0.2))
    at = Frame(cx, cy, float(rng.uniform(-0.25, 0.25)))
    w, d = float(rng.uniform(0.35, 0.48)) * width, float(rng.uniform(0.35, 0.45)) * depth
    b.box(at, (0, 0, 0.006), (w, d, 0.012), Material(tex.rug([pal.accent(), pal.pale, pal.accents[3]])))
    if kind == "dining":
        top = (float(rng.uniform(1.1, 1.5)), float(rng.uniform(0.75, 0.9)), 0.74)
        table(b, at, pal, top)
        for s in (-1, 1):
            for x in (-0.28 * top[0], 0.28 * top[0]):
                spot = at.point((x, s * (top[1] / 2 + 0.12), 0))
                chair(b, Frame(spot[0], spot[1], at.yaw + (math.pi if s > 0 else 0.0)), pal)
        reach = 0.95
    elif kind == "living":
        table(b, at, pal, (float(rng.uniform(0.8, 1.1)), 0.55, 0.42))
        reach = 0.6
    elif kind == "study":
        r = 0.3
        b.tube(at, (0, 0, 0.012), r, 0.4, pal.cloth())
        reach = r
    else:
        return
    floor.append((cx - reach, cx + reach, cy - reach, cy + reach))


def _against_wall(
    b: Builder,
    pal: Palette,
    piece: Piece,
    walls: list[Wall],
    taken: list[Taken],
    floor: Floor,
    rng: np.random.Generator,
) -> Light | None:
    """Tries random places along the walls until the piece is clear of all others; None after 60 failures."""
    w, d, h = (float(v * rng.uniform(0.92, 1.1)) for v in SIZES[piece])
    reach = d + (0.6 if piece is desk else 0.0)
    for _ in range(60):
        k = int(rng.integers(4))
        at, length = walls[k]
        room_for = (length - w) / 2 - 0.08
        if room_for <= 0:
            continue
        x = float(rng.uniform(-room_for, room_for))
        if _blocked(taken[k], x - w / 2 - GAP, x + w / 2 + GAP, h + (0.6 if piece in (tv_bench, desk) else 0.0)):
            continue
        ends = [at.point(p) for p in ((x - w / 2, 0.02, 0), (x + w / 2, reach, 0))]
        x0, x1 = sorted(p[0] for p in ends)
        y0, y1 = sorted(p[1] for p in ends)
        if any(x0 < f[1] + GAP and f[0] < x1 + GAP and y0 < f[3] + GAP and f[2] < y1 + GAP for f in floor):
            continue
        floor.append((x0, x1, y0, y1))
        taken[k].append((x - w / 2, x + w / 2, h + (0.75 if piece in (tv_bench, desk, dresser) else 0.1)))
        origin = at.point((x, 0.025, 0))
        return piece(b, Frame(origin[0], origin[1], at.yaw), pal, (w, d, h))
    return None


def _pictures(
    b: Builder, pal: Palette, walls: list[Wall], taken: list[Taken], height: float, rng: np.random.Generator
) -> None:
    for k, (at, length) in enumerate(walls):
        hung: list[tuple[float, float]] = []
        for _ in range(14):
            w, h = float(rng.uniform(0.45, 0.95)), float(rng.uniform(0.4, 0.75))
            x = float(rng.uniform(-1, 1)) * (length - w - 0.3) / 2
            z = float(rng.uniform(1.45, 1.7))
            over = any(a - 0.12 < x + w / 2 and x - w / 2 < c + 0.12 for a, c in hung)
            under = [free for a, c, free in taken[k] if x - w / 2 < c and a < x + w / 2]
            if over or any(free in OPENINGS or z - h / 2 < free for free in under) or z + h / 2 > height - 0.15:
                continue
            hung.append((x - w / 2, x + w / 2))
            art = Material(tex.picture(pal.accents + [pal.pale]), gloss=0.08, shininess=60.0)
            frame = Material(tex.plain(pal.dark_wood), gloss=0.15)
            b.box(at, (x, 0.015, z), (w, 0.03, h), {3: art, -1: frame})
            if len(hung) == 3:
                break
