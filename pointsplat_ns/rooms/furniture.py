"""The pieces of furniture and how they are set out along the walls and in the middle of a room.

A piece is built in its own frame: x along the wall, y from the wall into the room, z up, the middle
of its back edge at the origin (the middle of its foot for pieces that stand free).
"""

import math

import numpy as np

from pointsplat_ns.rooms import textures as tex
from pointsplat_ns.rooms.layout import Builder, Frame, Light, Material, Palette, Vec, hsv

GAP = 0.06  # metres left between neighbouring pieces
DOOR, WINDOW = 0.0, 0.85  # metres of wall free below an opening; furniture is told by its own height
OPENINGS = (DOOR, WINDOW)


def bookshelf(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    wood, t = pal.wood(), 0.03
    b.box(at, (0, 0.01, h / 2), (w, 0.02, h), wood)
    for s in (-1, 1):
        b.box(at, (s * (w - t) / 2, d / 2, h / 2), (t, d, h), wood)
    shelves = max(int(h / 0.36), 2)
    step = (h - t) / shelves
    for k in range(shelves + 1):
        b.box(at, (0, d / 2, t / 2 + k * step), (w, d, t), wood)
    for k in range(shelves):
        fill = pal.rng.uniform(0.55, 1.0) * (w - 2 * t)
        side = pal.rng.choice([-1, 1])
        tall = (step - t) * pal.rng.uniform(0.75, 0.92)
        row = Material(tex.books(pal.accents + [pal.pale, pal.dark_wood]), gloss=0.03)
        x = side * ((w - 2 * t) - fill) / 2
        b.box(at, (x, 0.4 * d + 0.01, t + k * step + tall / 2), (fill, 0.72 * d, tall), row)
        if (w - 2 * t) - fill > 0.2:
            r = min(0.07, (step - t) / 3)
            b.ball(at, (-side * ((w - 2 * t) / 2 - r - 0.02), d / 2, t + k * step + r), (r, r, r), pal.lacquer())


def sofa(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    cloth, arm = pal.cloth(), 0.18
    b.box(at, (0, d / 2, 0.21), (w, d, 0.34), cloth)
    b.box(at, (0, 0.11, h / 2), (w, 0.22, h), cloth)
    for s in (-1, 1):
        b.box(at, (s * (w - arm) / 2, d / 2, 0.3), (arm, d, 0.6), cloth)
    seats = 3 if w > 1.7 else 2
    each = (w - 2 * arm) / seats
    for k in range(seats):
        x = -w / 2 + arm + (k + 0.5) * each
        b.box(at, (x, 0.22 + (d - 0.22) / 2, 0.44), (each - 0.02, d - 0.24, 0.12), pal.cloth() if k == 1 else cloth)
    for s in (-1, 1):
        tilt = float(pal.rng.uniform(-0.3, 0.3))
        b.ball(at, (s * (w / 2 - arm - 0.22), 0.34, 0.66), (0.2, 0.1, 0.19), pal.cloth(), tilt)


def bed(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    wood, cloth = pal.wood(), pal.cloth()
    b.box(at, (0, 0.03, h / 2), (w + 0.06, 0.06, h), wood)
    b.box(at, (0, d / 2, 0.15), (w, d - 0.08, 0.26), wood)
    b.box(at, (0, d / 2, 0.37), (w - 0.06, d - 0.14, 0.2), Material(tex.fabric(pal.pale)))
    stripes = Material(tex.stripes([pal.accent(), pal.pale, pal.accent()], 0.11, horizontal=True))
    b.box(at, (0, 0.62 * d, 0.46), (w + 0.02, 0.66 * d, 0.07), cloth if pal.rng.random() < 0.5 else stripes)
    for s in (-1, 1):
        b.ball(at, (s * w / 4, 0.32, 0.55), (w / 4.6, 0.2, 0.1), Material(tex.fabric(pal.pale, pal.accent(), 0.12)))


def wardrobe(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    wood, front = pal.wood(), Material(tex.door(pal.wood_tone), gloss=0.08, shininess=50.0)
    b.box(at, (0, d / 2, h / 2), (w, d, h), wood)
    doors = max(int(w / 0.5), 1)
    for k in range(doors):
        x = -w / 2 + (k + 0.5) * w / doors
        b.box(at, (x, d + 0.01, h / 2 + 0.03), (w / doors - 0.015, 0.02, h - 0.1), front)


def dresser(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    wood, front = pal.wood(), pal.lacquer()
    b.box(at, (0, d / 2, h / 2), (w, d, h), wood)
    rows = max(int(h / 0.25), 1)
    for k in range(rows):
        z = (k + 0.5) * h / rows
        b.box(at, (0, d + 0.008, z), (w - 0.06, 0.016, h / rows - 0.03), front)
        b.ball(at, (0, d + 0.03, z), (0.06, 0.02, 0.018), pal.metal())
    ornament(b, Frame(*at.point((-w / 4, d / 2, 0))[:2], at.yaw), pal, h)


def tv_bench(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    b.box(at, (0, d / 2, h / 2), (w, d, h), pal.wood())
    black = Material(tex.plain((0.02, 0.02, 0.02)), gloss=0.3, shininess=90.0)
    image = Material(tex.picture(pal.accents, (0.02, 0.02, 0.02)), gloss=0.3, shininess=90.0)
    tall = 0.56 * 0.8 * w
    b.box(at, (0, 0.13, h + 0.05 + tall / 2), (0.8 * w, 0.05, tall), {3: image, -1: black})
    b.box(at, (0, 0.14, h + 0.03), (0.3 * w, 0.16, 0.05), black)


def desk(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    wood, metal = pal.wood(), pal.metal()
    b.box(at, (0, d / 2, h - 0.02), (w, d, 0.04), wood)
    for sx in (-1, 1):
        b.box(at, (sx * (w / 2 - 0.05), d / 2, (h - 0.04) / 2), (0.05, d - 0.08, h - 0.04), wood)
    shown = Material(tex.screen([pal.accent(), pal.accent()]), gloss=0.15, shininess=80.0)
    b.box(at, (-0.1, 0.16, h + 0.3), (0.58, 0.04, 0.36), {3: shown, -1: metal})
    b.tube(at, (-0.1, 0.16, h), 0.03, 0.14, metal)
    keys = Material(tex.tiles((0.1, 0.1, 0.1), (0.22, 0.22, 0.24), 0.04), gloss=0.05)
    b.box(at, (-0.1, 0.44, h + 0.012), (0.44, 0.15, 0.024), keys)
    books = Material(tex.stripes(pal.accents[:3], 0.04, horizontal=True), gloss=0.05)
    b.box(at, (w / 2 - 0.22, 0.22, h + 0.07), (0.26, 0.19, 0.14), books, turn=float(pal.rng.uniform(-0.4, 0.4)))
    chair(b, Frame(*at.point((-0.1, d + 0.3, 0))[:2], at.yaw + math.pi), pal)


def chair(b: Builder, at: Frame, pal: Palette) -> None:
    """Free standing, its back at -y."""
    wood, cloth = pal.wood(), pal.cloth()
    for sx in (-1, 1):
        for sy in (-1, 1):
            b.box(at, (sx * 0.18, sy * 0.18, 0.22), (0.04, 0.04, 0.44), wood)
    b.box(at, (0, 0, 0.46), (0.43, 0.43, 0.06), cloth)
    b.box(at, (0, -0.2, 0.72), (0.42, 0.04, 0.46), cloth)


def table(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    """Free standing; ``size`` is the top's width and depth and the height."""
    w, d, h = size
    top = pal.wood() if pal.rng.random() < 0.6 else Material(tex.marble(pal.pale, pal.dark_wood), 0.3, 80.0)
    b.box(at, (0, 0, h - 0.02), (w, d, 0.04), top)
    leg = pal.wood()
    for sx in (-1, 1):
        for sy in (-1, 1):
            b.box(at, (sx * (w / 2 - 0.06), sy * (d / 2 - 0.06), (h - 0.04) / 2), (0.06, 0.06, h - 0.04), leg)
    ornament(b, Frame(*at.point((0.15 * w, 0, 0))[:2], at.yaw), pal, h)
    book = Material(tex.picture(pal.accents, pal.accent()), gloss=0.1)
    b.box(at, (-0.22 * w, 0.05, h + 0.02), (0.3, 0.22, 0.04), book, turn=float(pal.rng.uniform(-0.5, 0.5)))


def ornament(b: Builder, at: Frame, pal: Palette, z: float) -> None:
    """A vase with a bunch, a bowl of fruit or a ball, standing at height ``z``."""
    style = pal.rng.integers(3)
    if style == 0:
        b.tube(at, (0, 0, z), 0.06, 0.2, pal.lacquer())
        for k in range(3):
            angle = 2.1 * k
            center = (0.08 * math.cos(angle), 0.08 * math.sin(angle), z + 0.29)
            b.ball(at, center, (0.09, 0.09, 0.08), Material(tex.leaves(pal.accent())))
    elif style == 1:
        b.ball(at, (0, 0, z + 0.05), (0.16, 0.16, 0.05), pal.lacquer())
        for k in range(3):
            angle = 2.1 * k + 0.4
            color = hsv(0.05 + 0.1 * k, 0.8, 0.85)
            fruit = Material(tex.plain(color, 0.2, 0.05), gloss=0.25, shininess=50.0)
            b.ball(at, (0.07 * math.cos(angle), 0.07 * math.sin(angle), z + 0.11), (0.05, 0.05, 0.05), fruit)
    else:
        globe = Material(tex.stripes([pal.accent(), pal.pale], 0.07), gloss=0.4, shininess=90.0)
        b.ball(at, (0, 0, z + 0.13), (0.13, 0.13, 0.13), globe)


def plant(b: Builder, at: Frame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    pot = Material(tex.stripes([pal.accent(), pal.pale], 0.06, horizontal=True), gloss=0.2, shininess=50.0)
    b.tube(at, (0, d / 2, 0), 0.34 * w, 0.35, pot)
    b.tube(at, (0, d / 2, 0.35), 0.03, h - 0.8, Material(tex.wood(pal.dark_wood, vertical=True)))
    for k in range(5):
        angle, r = 2.4 * k, 0.0 if k == 0 else 0.24 * w
        green = hsv(0.27 + 0.02 * k, 0.6, 0.55)
        center = (r * math.cos(angle), d / 2 + r * math.sin(angle), h - 0.35 + 0.07 * k)
        b.ball(at, center, (0.24 * w, 0.24 * w, 0.2), Material(tex.leaves(green), gloss=0.02), angle)


def floor_lamp(b: Builder, at: Frame, pal: Palette, size: Vec) -> Light:
    w, d, h = size
    metal = pal.metal()
    b.tube(at, (0, d / 2, 0), 0.14, 0.03, metal)
    b.tube(at, (0, d / 2, 0.03), 0.015, h - 0.3, metal, opaque=False)
    shade = Material(tex.stripes([(1.0, 0.8, 0.5), (0.9, 0.68, 0.4)], 0.08, horizontal=True), emission=1.3)
    b.tube(at, (0, d / 2, h - 0.28), 0.18, 0.28, shade, opaque=False)
    return Light(at.point((0, d / 2, h - 0.14)), (0, 0, 0), (0, 0, 0), None, (0.32, 0.26, 0.17))


TALL = {bookshelf: (1.0, 0.3, 1.9), wardrobe: (1.1, 0.55, 2.0)}
LOW = {dresser: (1.0, 0.45, 0.8), tv_bench: (1.4, 0.4, 0.45), desk: (1.3, 0.65, 0.74), sofa: (1.9, 0.88, 0.8)}
ROOMS = {
    "living": [sofa, tv_bench, bookshelf, floor_lamp, plant, dresser],
    "bedroom": [bed, wardrobe, dresser, floor_lamp, bookshelf, plant],
    "study": [desk, bookshelf, bookshelf, sofa, plant, floor_lamp, dresser],
    "dining": [dresser, bookshelf, plant, tv_bench, floor_lamp, wardrobe],
}


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
    taken: list[list[tuple[float, float, float]]] = [[], [], [], []]  # (from, to, lowest free height)
    floor: list[tuple[float, float, float, float]] = []  # x0, x1, y0, y1

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


def _walls(width: float, depth: float) -> list[tuple[Frame, float]]:
    return [
        (Frame(0, -depth / 2, 0.0), width),
        (Frame(width / 2, 0, math.pi / 2), depth),
        (Frame(0, depth / 2, math.pi), width),
        (Frame(-width / 2, 0, -math.pi / 2), depth),
    ]


def _blocked(taken: list[tuple[float, float, float]], x0: float, x1: float, top: float) -> bool:
    return any(x0 < b and a < x1 and top > free for a, b, free in taken)


def _window(b: Builder, at: Frame, length: float, height: float, pal: Palette, taken: list) -> Light:
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


def _middle(b: Builder, pal: Palette, kind: str, size: Vec, rng: np.random.Generator, floor: list) -> None:
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


def _against_wall(b: Builder, pal: Palette, piece, walls, taken, floor, rng: np.random.Generator) -> Light | None:
    """Tries places along the walls until the piece stands clear of all others; gives up after some."""
    sizes = {bed: (1.5, 2.0, 0.95), plant: (0.62, 0.62, 1.5), floor_lamp: (0.4, 0.4, 1.65), **TALL, **LOW}
    w, d, h = (float(v * rng.uniform(0.92, 1.1)) for v in sizes[piece])
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


def _pictures(b: Builder, pal: Palette, walls, taken, height: float, rng: np.random.Generator) -> None:
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
