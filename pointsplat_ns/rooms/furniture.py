"""The pieces of furniture.

A piece is built in its own frame: x along the wall, y from the wall into the room, z up, the middle
of its back edge at the origin (the middle of its foot for pieces that stand free).
"""

import math

from pointsplat_ns.rooms import textures as tex
from pointsplat_ns.rooms.building import Builder, Frame, Light, Material, Vec
from pointsplat_ns.rooms.palette import Palette, hsv


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
