"""Procedural surface colours for the built-in rooms.

Each texture is a function of metres on a surface. Nothing in them is finer than about 1.5 cm, so
that pictures of ordinary size can resolve it and no pixel pattern (moire) arises.
"""

from collections.abc import Callable

import numpy as np

Color = tuple[float, float, float]
Painter = Callable[["Canvas"], np.ndarray]


class Canvas:
    """What a texture is painted on: x, y (H, W) in metres from the top left, the size and a generator."""

    def __init__(self, width: float, height: float, columns: int, rows: int, seed: int):
        self.width, self.height = width, height
        self.rng = np.random.default_rng(seed)
        x = (np.arange(columns, dtype=np.float32) + 0.5) * (width / columns)
        y = (np.arange(rows, dtype=np.float32) + 0.5) * (height / rows)
        self.x, self.y = np.meshgrid(x, y)

    def noise(self, scale: float, stretch: float = 1.0) -> np.ndarray:
        """Smooth value noise in [0, 1], lattice spacing ``scale`` metres in y and ``scale * stretch`` in x."""
        gx, gy = self.x / (scale * stretch), self.y / scale
        lattice = self.rng.random((int(gy.max()) + 2, int(gx.max()) + 2), dtype=np.float32)
        i, j = gx.astype(int), gy.astype(int)
        fx, fy = _smooth(gx - i), _smooth(gy - j)
        top = lattice[j, i] * (1 - fx) + lattice[j, i + 1] * fx
        bottom = lattice[j + 1, i] * (1 - fx) + lattice[j + 1, i + 1] * fx
        return top * (1 - fy) + bottom * fy

    def clouds(self, scale: float, octaves: int = 3, stretch: float = 1.0) -> np.ndarray:
        """Octaves of :meth:`noise`, each half as large and half as strong, in [0, 1]."""
        total, weight = np.zeros_like(self.x), 0.0
        for octave in range(octaves):
            total += self.noise(max(scale / 2**octave, 0.015), stretch) / 2**octave
            weight += 1 / 2**octave
        return total / weight

    def fill(self, color: Color) -> np.ndarray:
        return np.broadcast_to(np.asarray(color, np.float32), (*self.x.shape, 3)).copy()


def _smooth(t: np.ndarray) -> np.ndarray:
    return t * t * (3 - 2 * t)


def _step(signed: np.ndarray, width: float = 0.006) -> np.ndarray:
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

    def paint(c: Canvas) -> np.ndarray:
        return c.fill(color) * (1 - grain + 2 * grain * c.clouds(scale))[..., None]

    return paint


def wood(color: Color, board: float = 0.0, length: float = 1.2, vertical: bool = False) -> Painter:
    """Wood grain along x (or y); ``board`` metres wide planks with staggered joints, 0 for one piece."""

    def paint(c: Canvas) -> np.ndarray:
        if vertical:
            c.x, c.y = c.y, c.x
        ring = 0.5 + 0.5 * np.sin(2 * np.pi * (c.y / 0.05 + 2.2 * c.noise(0.10, 6.0)))
        shade = 0.80 + 0.22 * c.clouds(0.06, 2, 7.0) + 0.12 * ring * c.noise(0.3)
        if board:
            row, edge = _cells(c.y, board)
            offset = c.rng.random(row.max() + 1)[row] * length
            column, end = _cells(c.x + offset, length)
            tone = c.rng.random((row.max() + 1, column.max() + 1))[row, column]
            shade = shade * (0.76 + 0.40 * tone)
            shade = shade * (0.45 + 0.55 * _step(np.minimum(edge, end) - 0.006, 0.008))
        warm = np.array([1.0, 0.93, 0.84], np.float32)
        return c.fill(color) * shade[..., None] * (1 + (warm - 1) * (1 - shade[..., None]))

    return paint


def tiles(a: Color, b: Color, size: float, grout: Color = (0.55, 0.53, 0.5)) -> Painter:
    """Square tiles of two colours in a checkerboard, with joints."""

    def paint(c: Canvas) -> np.ndarray:
        i, dx = _cells(c.x, size)
        j, dy = _cells(c.y, size)
        tone = 0.86 + 0.2 * c.rng.random((j.max() + 1, i.max() + 1))[j, i]
        color = _mix(c.fill(a), b, ((i + j) % 2).astype(np.float32))
        color = color * (tone * (0.86 + 0.24 * c.clouds(0.15)))[..., None]
        return _mix(color, grout, 1 - _step(np.minimum(dx, dy) - 0.006))

    return paint


def bricks(color: Color, mortar: Color = (0.72, 0.69, 0.64)) -> Painter:
    """A wall of bricks, 25 x 8 cm."""

    def paint(c: Canvas) -> np.ndarray:
        row, dy = _cells(c.y, 0.083)
        column, dx = _cells(c.x + 0.125 * (row % 2), 0.25)
        tone = 0.65 + 0.5 * c.rng.random((row.max() + 1, column.max() + 1))[row, column]
        color_ = c.fill(color) * (tone * (0.8 + 0.4 * c.clouds(0.07, 2)))[..., None]
        return _mix(color_, mortar, 1 - _step(np.minimum(dx, dy) - 0.007, 0.007))

    return paint


def stripes(colors: list[Color], width: float, horizontal: bool = False, soft: float = 0.008) -> Painter:
    """Stripes of equal width in turn, upright unless ``horizontal``."""

    def paint(c: Canvas) -> np.ndarray:
        along = c.y if horizontal else c.x
        index = np.floor(along / width).astype(int)
        table = np.asarray(colors, np.float32)
        base = table[index % len(colors)]
        following = table[(index + 1) % len(colors)]
        edge = _step((along - (index + 1) * width) + soft / 2, soft)
        return (base + (following - base) * edge[..., None]) * (0.9 + 0.16 * c.clouds(0.2))[..., None]

    return paint


def wallpaper(base: Color, motif: Color, size: float) -> Painter:
    """Staggered medallions with dots between them."""

    def paint(c: Canvas) -> np.ndarray:
        row = np.floor(c.y / size)
        px = (c.x / size + 0.5 * (row % 2)) % 1.0 - 0.5
        py = (c.y / size) % 1.0 - 0.5
        radius, angle = np.hypot(px, py), np.arctan2(py, px)
        petal = 0.30 + 0.10 * np.cos(6 * angle)
        color = _mix(c.fill(base), motif, _step((petal - radius) * size, 0.012) * 0.75)
        color = _mix(color, base, _step((0.15 - radius) * size, 0.012))
        color = _mix(color, motif, _step((0.07 - radius) * size, 0.012))
        return color * (0.92 + 0.14 * c.clouds(0.35))[..., None]

    return paint


def fabric(color: Color, second: Color | None = None, check: float = 0.0) -> Painter:
    """Woven cloth with soft mottling; with ``check`` metres, a tartan of the second colour."""

    def paint(c: Canvas) -> np.ndarray:
        out = c.fill(color)
        if second is not None and check:
            bands = [_step(0.5 * check - np.abs((t % check) - check / 2) * 2, 0.01) for t in (c.x, c.y)]
            out = _mix(out, second, 0.45 * (bands[0] + bands[1]))
        weave = 0.5 + 0.25 * np.sin(c.x * (2 * np.pi / 0.032)) + 0.25 * np.sin(c.y * (2 * np.pi / 0.032))
        return out * (0.78 + 0.1 * weave + 0.24 * c.clouds(0.09))[..., None]

    return paint


def rug(colors: list[Color]) -> Painter:
    """Borders around a field of diamonds."""

    def paint(c: Canvas) -> np.ndarray:
        edge = np.minimum(np.minimum(c.x, c.width - c.x), np.minimum(c.y, c.height - c.y))
        out = c.fill(colors[0])
        size = 0.28
        diamond = np.abs((c.x / size) % 1 - 0.5) + np.abs((c.y / size) % 1 - 0.5)
        out = _mix(out, colors[1], _step((0.38 - diamond) * size))
        out = _mix(out, colors[2], _step((0.2 - diamond) * size))
        for k, limit in enumerate((0.2, 0.15, 0.06)):
            out = _mix(out, colors[(k + 1) % len(colors)], _step(limit - edge))
        return out * (0.82 + 0.3 * c.clouds(0.06, 2))[..., None]

    return paint


def picture(colors: list[Color], frame: Color = (0.12, 0.1, 0.08)) -> Painter:
    """A framed painting: a horizon with hills and a sun, or overlapping discs and bars."""

    def paint(c: Canvas) -> np.ndarray:
        rng = c.rng
        out = _mix(c.fill(colors[0]), colors[1], np.clip(c.y / c.height, 0, 1))
        if rng.random() < 0.5:
            sun = np.hypot(c.x - rng.uniform(0.2, 0.8) * c.width, c.y - 0.3 * c.height)
            out = _mix(out, (0.95, 0.85, 0.5), _step(0.12 * min(c.width, c.height) - sun, 0.01))
            for k in range(3):
                ridge = c.height * (0.45 + 0.17 * k)
                phase, wave = rng.uniform(0, 6), rng.uniform(3, 7) / c.width
                line = ridge + 0.08 * c.height * np.sin(c.x * wave + phase)
                out = _mix(out, np.asarray(colors[(2 + k) % len(colors)]) * (0.9 - 0.2 * k), _step(c.y - line, 0.01))
        else:
            for k in range(9):
                color = colors[rng.integers(len(colors))]
                cx, cy = rng.random() * c.width, rng.random() * c.height
                size = rng.uniform(0.08, 0.3) * min(c.width, c.height)
                if k % 3 == 2:
                    inside = np.minimum(size * 0.4 - np.abs(c.x - cx), size * 1.6 - np.abs(c.y - cy))
                else:
                    inside = size - np.hypot(c.x - cx, c.y - cy)
                out = _mix(out, color, _step(inside, 0.01) * 0.9)
        edge = np.minimum(np.minimum(c.x, c.width - c.x), np.minimum(c.y, c.height - c.y))
        out = out * (0.9 + 0.2 * c.clouds(0.05, 2))[..., None]
        out = _mix(out, (0.88, 0.86, 0.8), _step(0.065 - edge))
        return _mix(out, frame, _step(0.035 - edge))

    return paint


def books(colors: list[Color]) -> Painter:
    """A row of book spines of varied width, height and colour, some with a band."""

    def paint(c: Canvas) -> np.ndarray:
        rng = c.rng
        edges = np.cumsum(rng.uniform(0.022, 0.06, int(c.width / 0.022) + 2))
        book = np.searchsorted(edges, c.x)
        count = len(edges) + 1
        table = np.asarray(colors, np.float32)[rng.integers(len(colors), size=count)]
        table = table * rng.uniform(0.6, 1.15, (count, 1)).astype(np.float32)
        out = table[book]
        band = np.abs(c.y - (c.height * rng.uniform(0.25, 0.75, count))[book]) - 0.016
        banded = rng.random(count)[book] < 0.6
        out = _mix(out, (0.85, 0.78, 0.55), _step(-band) * banded)
        start = np.concatenate([[0.0], edges])[book]
        end = np.concatenate([edges, [edges[-1] + 1]])[book]
        gap = np.minimum(c.x - start, end - c.x)
        out = out * (0.4 + 0.6 * _step(gap - 0.003, 0.008))[..., None]
        top = (c.height * rng.uniform(0.02, 0.28, count))[book]
        return _mix(out, (0.05, 0.045, 0.04), _step(top - c.y, 0.008))

    return paint


def leaves(color: Color) -> Painter:
    """Foliage: overlapping dark and light blotches."""

    def paint(c: Canvas) -> np.ndarray:
        blotch = _smooth(np.clip(c.noise(0.06) * 1.6 - 0.3, 0, 1))
        out = _mix(c.fill(color) * 0.45, color, blotch)
        fresh = np.asarray(color) * np.array([1.35, 1.2, 0.8])
        return _mix(out, fresh, _smooth(np.clip(c.noise(0.05) * 3 - 1.8, 0, 1)))

    return paint


def marble(color: Color, vein: Color) -> Painter:
    """Stone with soft veins."""

    def paint(c: Canvas) -> np.ndarray:
        wave = np.abs(np.sin(2 * np.pi * (c.x / 0.5 + c.y / 0.9) + 7 * c.clouds(0.35)))
        return _mix(c.fill(color) * (0.9 + 0.15 * c.clouds(0.2))[..., None], vein, np.clip(1 - wave * 4, 0, 1) * 0.8)

    return paint


def door(color: Color) -> Painter:
    """A panelled door with a handle."""

    def paint(c: Canvas) -> np.ndarray:
        rows, columns = c.x.shape
        out = wood(color, vertical=True)(Canvas(c.width, c.height, columns, rows, int(c.rng.integers(1 << 30))))
        for x0, x1, y0, y1 in ((0.15, 0.85, 0.07, 0.42), (0.15, 0.85, 0.52, 0.93)):
            inside = np.minimum(
                np.minimum(c.x - x0 * c.width, x1 * c.width - c.x), np.minimum(c.y - y0 * c.height, y1 * c.height - c.y)
            )
            out = out * (1 - 0.45 * np.clip(1 - np.abs(inside) / 0.018, 0, 1))[..., None]
        return _mix(out, (0.75, 0.7, 0.55), _step(0.035 - np.hypot(c.x - 0.9 * c.width, (c.y - 0.5 * c.height) * 0.6)))

    return paint


def window(sky: Color, ground: Color, panes: tuple[int, int], bar: Color = (0.35, 0.34, 0.32)) -> Painter:
    """A view out: sky with clouds, hills, and the bars between the panes."""

    def paint(c: Canvas) -> np.ndarray:
        t = c.y / c.height
        out = _mix(c.fill(sky), (0.9, 0.93, 0.96), np.clip(t * 1.3, 0, 1))
        out = _mix(out, (1.0, 1.0, 1.0), _smooth(np.clip(c.clouds(0.3, 3, 2.0) * 2.4 - 1.0, 0, 1)) * 0.7)
        line = c.height * (0.66 + 0.05 * np.sin(c.x * 4 + c.rng.uniform(0, 6)))
        out = _mix(out, ground, _step(c.y - line, 0.02))
        for along, size, count in ((c.x, c.width, panes[0]), (c.y, c.height, panes[1])):
            spacing = size / count
            _, distance = _cells(np.minimum(along, size - 1e-6), spacing)
            out = _mix(out, bar, _step(0.022 - distance))
        return out

    return paint


def screen(colors: list[Color]) -> Painter:
    """A display showing windows with lines of text-like blocks."""

    def paint(c: Canvas) -> np.ndarray:
        out = _mix(c.fill(colors[0]), colors[1], c.noise(0.25))
        rng = c.rng
        for _ in range(3):
            x0, y0 = rng.uniform(0.03, 0.5) * c.width, rng.uniform(0.05, 0.4) * c.height
            x1, y1 = x0 + 0.42 * c.width, y0 + 0.5 * c.height
            inside = np.minimum(np.minimum(c.x - x0, x1 - c.x), np.minimum(c.y - y0, y1 - c.y))
            out = _mix(out, (0.85, 0.86, 0.88), _step(inside))
            line = ((c.y - y0) % 0.05 < 0.02) & (c.x < x0 + (x1 - x0) * (0.5 + 0.4 * c.noise(0.05, 50)))
            out = _mix(out, (0.25, 0.3, 0.4), ((inside > 0.025) & line).astype(np.float32))
        edge = np.minimum(np.minimum(c.x, c.width - c.x), np.minimum(c.y, c.height - c.y))
        return _mix(out, (0.03, 0.03, 0.03), _step(0.02 - edge))

    return paint
