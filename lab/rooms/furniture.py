"""The colours of a room, and its pieces of furniture.

A piece is built in its own frame: x along the wall, y from the wall into the room, z up, the middle
of its back edge at the origin (for a table, a chair and an ornament: the middle of its foot).
``size`` is width, depth and height, metres.
"""

import colorsys

import numpy as np

from lab.rooms import textures as tex
from lab.rooms.building import Builder, LocalFrame, Material, Vec


def hsv(hue: float, saturation: float, value: float) -> tex.Color:
    """Linear-light colour of hue, saturation and value in [0, 1]."""
    r, g, b = colorsys.hsv_to_rgb(hue % 1.0, saturation, value)
    return (r**2.2, g**2.2, b**2.2)


class Palette:
    """The colours and materials of one room, drawn once so that its pieces belong together."""

    def __init__(self, rng: np.random.Generator):
        hue = rng.random()
        self.rng = rng
        self.accents = [
            hsv(hue + d, rng.uniform(0.5, 0.85), rng.uniform(0.45, 0.85))
            for d in (0.0, 0.08, 0.33, 0.5)
        ]
        self.wall = hsv(rng.random(), rng.uniform(0.05, 0.28), rng.uniform(0.78, 0.92))
        self.timber = hsv(rng.uniform(0.04, 0.1), rng.uniform(0.4, 0.65), rng.uniform(0.4, 0.85))
        self.pale = hsv(rng.uniform(0.05, 0.15), 0.08, 0.9)
        self.wood = Material(tex.wood(self.timber), gloss=0.08)
        self.white = Material(tex.plain(self.pale), gloss=0.08)
        self.metal = Material(tex.plain((0.3, 0.3, 0.32)), gloss=0.5)

    def accent(self) -> tex.Color:
        return self.accents[self.rng.integers(len(self.accents))]

    def cloth(self) -> Material:
        return Material(
            tex.fabric(self.accent(), self.accent(), float(self.rng.choice([0.0, 0.0, 0.28, 0.4])))
        )

    def lacquer(self) -> Material:
        return Material(
            tex.plain(self.accent(), 0.15, 0.12),
            gloss=0.35,
            shininess=float(self.rng.uniform(40, 110)),
        )


def bookshelf(b: Builder, at: LocalFrame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    b.box(at, (0, 0.01, h / 2), (w, 0.02, h), pal.wood)
    for side in (-1, 1):
        b.box(at, (side * (w - 0.03) / 2, d / 2, h / 2), (0.03, d, h), pal.wood)
    shelves = int(h / 0.36)
    step = (h - 0.03) / shelves
    for k in range(shelves + 1):
        b.box(at, (0, d / 2, 0.015 + k * step), (w, d, 0.03), pal.wood)
    for k in range(shelves):
        tall = (step - 0.03) * pal.rng.uniform(0.75, 0.92)
        fill = (w - 0.06) * pal.rng.uniform(0.55, 1.0)
        row = Material(
            tex.stripes([*pal.rng.permutation([*pal.accents, pal.pale, *pal.accents])], 0.045),
            gloss=0.03,
        )
        b.box(
            at,
            ((fill - w) / 2 + 0.03, 0.4 * d, 0.03 + k * step + tall / 2),
            (fill, 0.72 * d, tall),
            row,
        )


def sofa(b: Builder, at: LocalFrame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    cloth = pal.cloth()
    third = (w - 0.36) / 3
    b.box(at, (0, d / 2, 0.19), (w, d, 0.38), cloth)
    b.box(at, (0, 0.11, h / 2), (w, 0.22, h), cloth)
    for side in (-1, 1):
        b.box(at, (side * (w - 0.18) / 2, d / 2, 0.3), (0.18, d, 0.6), cloth)
        b.box(at, (side * (w / 2 - 0.4), 0.34, 0.66), (0.4, 0.2, 0.38), pal.cloth(), round=True)
    for k in (-1, 0, 1):
        b.box(
            at,
            (k * third, 0.11 + d / 2, 0.44),
            (third - 0.02, d - 0.24, 0.12),
            cloth if k else pal.cloth(),
        )


def wardrobe(b: Builder, at: LocalFrame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    b.box(at, (0, d / 2, h / 2), (w, d, h), pal.wood)
    for side in (-1, 1):
        b.box(at, (side * w / 4, d + 0.01, h / 2 + 0.03), (w / 2 - 0.015, 0.02, h - 0.1), pal.white)
        b.box(at, (side * 0.06, d + 0.03, h / 2), (0.02, 0.04, 0.2), pal.metal, round=True)


def dresser(b: Builder, at: LocalFrame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    front = pal.lacquer()
    b.box(at, (0, d / 2, h / 2), (w, d, h), pal.wood)
    for k in range(3):
        z = (k + 0.5) * h / 3
        b.box(at, (0, d + 0.008, z), (w - 0.06, 0.016, h / 3 - 0.03), front)
        b.box(at, (0, d + 0.03, z), (0.12, 0.04, 0.036), pal.metal, round=True)
    ornament(b, at.moved(-w / 4, d / 2), pal, h)


def television(b: Builder, at: LocalFrame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    b.box(at, (0, d / 2, h / 2), (w, d, h), pal.wood)
    black = Material(tex.plain((0.02, 0.02, 0.02)), gloss=0.3, shininess=90.0)
    shown = Material(tex.picture(pal.accents), gloss=0.3, shininess=90.0)
    b.box(at, (0, 0.13, h + 0.05 + 0.22 * w), (0.8 * w, 0.05, 0.44 * w), black, front=shown)
    b.box(at, (0, 0.14, h + 0.03), (0.3 * w, 0.16, 0.06), black)


def chair(b: Builder, at: LocalFrame, pal: Palette) -> None:
    """Its back is at -y."""
    cloth = pal.cloth()
    for x, y in ((-0.18, -0.18), (-0.18, 0.18), (0.18, -0.18), (0.18, 0.18)):
        b.box(at, (x, y, 0.22), (0.04, 0.04, 0.44), pal.wood)
    b.box(at, (0, 0, 0.46), (0.43, 0.43, 0.06), cloth)
    b.box(at, (0, -0.2, 0.72), (0.42, 0.04, 0.46), cloth)


def table(b: Builder, at: LocalFrame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    b.box(at, (0, 0, h - 0.02), (w, d, 0.04), pal.wood)
    for x, y in ((-1, -1), (-1, 1), (1, -1), (1, 1)):
        b.box(
            at,
            (x * (w / 2 - 0.06), y * (d / 2 - 0.06), (h - 0.04) / 2),
            (0.06, 0.06, h - 0.04),
            pal.wood,
        )
    ornament(b, at.moved(0.15 * w, 0), pal, h)
    b.box(
        at,
        (-0.22 * w, 0.05, h + 0.02),
        (0.3, 0.22, 0.04),
        Material(tex.picture(pal.accents), gloss=0.1),
    )


def ornament(b: Builder, at: LocalFrame, pal: Palette, z: float) -> None:
    """A bowl of fruit or a striped ball, standing at height ``z``."""
    if pal.rng.random() < 0.4:
        ball = Material(tex.stripes([pal.accent(), pal.pale], 0.07), gloss=0.4, shininess=90.0)
        return b.box(at, (0, 0, z + 0.1), (0.2, 0.2, 0.2), ball, round=True)
    b.box(at, (0, 0, z + 0.05), (0.32, 0.32, 0.1), pal.lacquer(), round=True)
    for k, (x, y) in enumerate(((0.07, 0), (-0.04, 0.06), (-0.04, -0.06))):
        fruit = Material(tex.plain(hsv(0.05 + 0.1 * k, 0.8, 0.85), 0.2, 0.05), gloss=0.25)
        b.box(at, (x, y, z + 0.11), (0.1, 0.1, 0.1), fruit, round=True)


def plant(b: Builder, at: LocalFrame, pal: Palette, size: Vec) -> None:
    w, d, h = size
    pot = Material(tex.stripes([pal.accent(), pal.pale], 0.06, horizontal=True), gloss=0.2)
    b.box(at, (0, d / 2, 0.18), (0.6 * w, 0.6 * w, 0.36), pot)
    b.box(at, (0, d / 2, h / 2 - 0.1), (0.05, 0.05, h - 0.5), pal.wood)
    for k, (x, y) in enumerate(((0, 0), (0.24, 0.1), (-0.24, 0.12), (0.06, -0.22), (0, 0.24))):
        leaves = Material(tex.fabric(hsv(0.27 + 0.02 * k, 0.6, 0.55), hsv(0.25, 0.5, 0.75), 0.12))
        center = (x * w, d / 2 + y * w, h - 0.5 + 0.07 * k)
        b.box(at, center, (0.48 * w, 0.48 * w, 0.4), leaves, round=True)
