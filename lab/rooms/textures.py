"""Procedural colours of surfaces, as functions of metres on a surface.

Nothing in them is finer than about 1.5 cm, so that pictures of ordinary size resolve it and show no
moire.
"""

from collections.abc import Callable

import numpy as np

Color = tuple[float, float, float]
"""Linear light, each channel in [0, 1]."""


class Canvas:
    """A surface to paint on: x and y (H, W) in metres from its top left, its size, and a
    generator."""

    def __init__(self, width: float, height: float, columns: int, rows: int, seed: int):
        self.width = width
        self.height = height
        self.rng = np.random.default_rng(seed)
        x = (np.arange(columns, dtype=np.float32) + 0.5) * (width / columns)
        y = (np.arange(rows, dtype=np.float32) + 0.5) * (height / rows)
        self.x, self.y = np.meshgrid(x, y)
        self.edge = np.minimum(
            np.minimum(self.x, width - self.x), np.minimum(self.y, height - self.y)
        )
        """Distance to the nearest edge, metres."""

    def noise(self, scale: float, stretch: float = 1.0) -> np.ndarray:
        """Smooth value noise in [0, 1], lattice spacing ``scale`` metres in y and ``scale *
        stretch`` in x."""
        gx = self.x / (scale * stretch)
        gy = self.y / scale
        lattice = self.rng.random((int(gy.max()) + 2, int(gx.max()) + 2), dtype=np.float32)
        i = gx.astype(int)
        j = gy.astype(int)
        fx = _smooth(gx - i)
        fy = _smooth(gy - j)
        top = lattice[j, i] * (1 - fx) + lattice[j, i + 1] * fx
        bottom = lattice[j + 1, i] * (1 - fx) + lattice[j + 1, i + 1] * fx
        return top * (1 - fy) + bottom * fy

    def clouds(self, scale: float, octaves: int = 3, stretch: float = 1.0) -> np.ndarray:
        """Octaves of :meth:`noise`, each half as large and half as strong, in [0, 1]."""
        weights = [0.5**octave for octave in range(octaves)]
        parts = [weight * self.noise(max(scale * weight, 0.015), stretch) for weight in weights]
        return np.sum(parts, axis=0) / sum(weights)

    def fill(self, color: Color) -> np.ndarray:
        return np.broadcast_to(np.asarray(color, np.float32), (*self.x.shape, 3)).copy()


Painter = Callable[[Canvas], np.ndarray]
"""Gives the colours (H, W, 3) of a canvas."""


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * (3 - 2 * t)


def _step(signed: np.ndarray, width: float = 0.008) -> np.ndarray:
    """0 to 1 across an edge: ``signed`` metres beyond it, blended over ``width``."""
    return np.clip(signed / width + 0.5, 0, 1)


def _mix(a: np.ndarray, b, t: np.ndarray) -> np.ndarray:
    return a + (np.asarray(b, np.float32) - a) * t[..., None]


def _cells(values: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Index of the cell and distance in metres to its nearest border."""
    cell = np.floor(values / size)
    inside = values - cell * size
    return cell.astype(int), np.minimum(inside, size - inside)


def plain(color: Color, grain: float = 0.08, scale: float = 0.25) -> Painter:
    """Plaster, paint or plastic: one colour, faintly clouded."""
    return lambda c: c.fill(color) * (1 - grain + 2 * grain * c.clouds(scale))[..., None]


def wood(color: Color, board: float = 0.0) -> Painter:
    """Wood with its grain along the longer side; ``board`` is the width of planks in metres, 0 for
    one piece."""

    def paint(c: Canvas) -> np.ndarray:
        if c.height > c.width:
            c.x, c.y = c.y, c.x
        ring = 0.5 + 0.5 * np.sin(2 * np.pi * (c.y / 0.05 + 2.2 * c.noise(0.10, 6.0)))
        shade = 0.80 + 0.22 * c.clouds(0.06, 2, 7.0) + 0.12 * ring * c.noise(0.3)
        if board:
            row, edge = _cells(c.y, board)
            column, end = _cells(c.x + 1.2 * c.rng.random(row.max() + 1)[row], 1.2)
            tone = c.rng.random((row.max() + 1, column.max() + 1))[row, column]
            shade = (
                shade * (0.76 + 0.40 * tone) * (0.45 + 0.55 * _step(np.minimum(edge, end) - 0.006))
            )
        return c.fill(color) * shade[..., None]

    return paint


def stripes(colors: list[Color], width: float, horizontal: bool = False) -> Painter:
    """Stripes of several colours, faintly clouded."""

    def paint(c: Canvas) -> np.ndarray:
        index, _ = _cells(c.y if horizontal else c.x, width)
        return (
            np.asarray(colors, np.float32)[index % len(colors)]
            * (0.9 + 0.16 * c.clouds(0.2))[..., None]
        )

    return paint


def fabric(color: Color, second: Color, check: float = 0.0) -> Painter:
    """Mottled cloth; with ``check`` metres, a tartan of the second colour."""

    def paint(c: Canvas) -> np.ndarray:
        out = c.fill(color)
        for along in (c.x, c.y) if check else ():
            out = _mix(out, second, 0.45 * _step(_cells(along, check)[1] - check / 4))
        return out * (0.8 + 0.3 * c.clouds(0.09))[..., None]

    return paint


def rug(colors: list[Color]) -> Painter:
    """Borders around a field of diamonds, in three colours."""

    def paint(c: Canvas) -> np.ndarray:
        size = 0.28
        diamond = np.abs((c.x / size) % 1 - 0.5) + np.abs((c.y / size) % 1 - 0.5)
        out = _mix(c.fill(colors[0]), colors[1], _step((0.38 - diamond) * size))
        out = _mix(out, colors[2], _step((0.2 - diamond) * size))
        for number, limit in enumerate((0.2, 0.15, 0.06)):
            out = _mix(out, colors[(number + 1) % 3], _step(limit - c.edge))
        return out * (0.82 + 0.3 * c.clouds(0.06, 2))[..., None]

    return paint


def picture(colors: list[Color]) -> Painter:
    """A framed painting: overlapping discs over a gradient."""

    def paint(c: Canvas) -> np.ndarray:
        out = _mix(c.fill(colors[0]), colors[1], c.y / c.height)
        for _ in range(9):
            x = c.rng.random() * c.width
            y = c.rng.random() * c.height
            size = c.rng.uniform(0.08, 0.3)
            inside = size * min(c.width, c.height) - np.hypot(c.x - x, c.y - y)
            out = _mix(out, colors[c.rng.integers(len(colors))], 0.9 * _step(inside, 0.01))
        out = _mix(
            out * (0.9 + 0.2 * c.clouds(0.05, 2))[..., None],
            (0.88, 0.86, 0.8),
            _step(0.065 - c.edge),
        )
        return _mix(out, (0.12, 0.1, 0.08), _step(0.035 - c.edge))

    return paint


def window(sky: Color, ground: Color, panes: int) -> Painter:
    """A view out: sky with clouds, hills, and the bars between two rows of panes."""

    def paint(c: Canvas) -> np.ndarray:
        out = _mix(c.fill(sky), (0.9, 0.93, 0.96), np.clip(1.3 * c.y / c.height, 0, 1))
        out = _mix(
            out, (1.0, 1.0, 1.0), 0.7 * _smooth(np.clip(2.4 * c.clouds(0.3, 3, 2.0) - 1.0, 0, 1))
        )
        hills = c.height * (0.66 + 0.05 * np.sin(c.x * 4 + c.rng.uniform(0, 6)))
        out = _mix(out, ground, _step(c.y - hills, 0.02))
        for along, spacing in ((c.x, c.width / panes), (c.y, c.height / 2)):
            out = _mix(out, (0.35, 0.34, 0.32), _step(0.022 - _cells(along, spacing)[1]))
        return out

    return paint
