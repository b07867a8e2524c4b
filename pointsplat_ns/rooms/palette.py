"""The colours and materials of a room."""

import colorsys

import numpy as np

from pointsplat_ns.rooms import textures as tex
from pointsplat_ns.rooms.building import Material


def hsv(hue: float, saturation: float, value: float) -> tex.Color:
    """Linear-light colour of hue, saturation and value in [0, 1]."""
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
            r, g, b = self.wall
            darker = (0.78 * r, 0.78 * g, 0.78 * b)
            return Material(tex.stripes([self.wall, darker], float(self.rng.uniform(0.08, 0.16))))
        if style == 2:
            r, g, b = (0.5 * np.asarray(self.wall) + 0.5 * np.asarray(self.accent())).tolist()
            motif = (r, g, b)
            return Material(tex.wallpaper(self.wall, motif, float(self.rng.uniform(0.25, 0.4))))
        return Material(tex.plain(self.wall, 0.07, 0.4))
