"""Windows of pictures at the size that people look at.

3DGS rasterizers widen every projected Gaussian by 0.3 pixels, so a scene that is right in small pictures may be wrong
in large ones, and the other way around. A window is a part of a picture at one of several sizes, from small to full. It
costs as much as a small picture of as many pixels, and is a crop of the large picture.
"""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.closeness import DenseReference
from pointsplat_ns.looking.each_view import each_view
from pointsplat_ns.looking.settings import DEFAULTS, LookingSettings
from pointsplat_ns.metrics import MOST_PSNR
from pointsplat_ns.rasterizer import render_with_alpha
from pointsplat_ns.views import View, Views

RESOLUTION = (1920, 1080)
"""Width and height of sampled views, pixels: the size that most people look at."""

MAX_SIDE = 16384
"""Largest width or height of a resolution, pixels."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Windows of views, by the size of the whole pictures."""

    sides: tuple[int, ...]
    """Longer sides of the whole pictures, pixels, ascending."""
    views: tuple[Views, ...]
    """Windows for each side, the same number of each view."""


def parse_resolution(text: str | tuple[int, int] | None) -> tuple[int, int] | None:
    """Width and height of pictures, pixels, as in "1920x1080"; None stays None.

    Raises:
        PointSplatError: if it is neither.

    Example:
        >>> parse_resolution("1920x1080"), parse_resolution((640, 480))
        ((1920, 1080), (640, 480))
    """
    if text is None:
        return None
    parts = text.lower().split("x") if isinstance(text, str) else [str(part) for part in text]
    if len(parts) != 2 or not all(part.strip().isdecimal() and 1 <= int(part) <= MAX_SIDE for part in parts):
        raise PointSplatError(f"resolution is {text!r}; expected width and height in pixels, such as 1920x1080")
    return int(parts[0]), int(parts[1])


def size_text(resolution: tuple[int, int]) -> str:
    """A width and height as :func:`parse_resolution` reads them."""
    return "x".join(map(str, resolution))


def sides_of(width: int, height: int, settings: LookingSettings = DEFAULTS) -> tuple[int, ...]:
    """Longer sides of the pictures that windows are taken from, pixels: ``window_side`` of the settings, the whole
    size, and their geometric mean. The whole size alone if it is no larger than a window.

    Example:
        >>> sides_of(1920, 1080), sides_of(540, 360), sides_of(64, 48)
        ((320, 784, 1920), (320, 416, 540), (64,))
    """
    longest, window_side = max(width, height), settings.window_side
    return (longest,) if longest <= window_side else (window_side, round(math.sqrt(window_side * longest)), longest)


def middle_sized(views: Views, settings: LookingSettings = DEFAULTS) -> Views:
    """Views at the middle one of their :func:`sides_of`: nearly as large as people look at, and quick to draw."""
    sides = sides_of(views.width, views.height, settings)
    return views.resized(sides[len(sides) // 2])


def window(view: View, side: int, at: tuple[float, float] = (0.5, 0.5), settings: LookingSettings = DEFAULTS) -> View:
    """A window of a picture that is scaled to a longer side of ``side`` pixels.

    Args:
        view: the whole picture.
        side: longer side of the scaled picture, pixels. If it is larger than the view's own, the window is a zoom.
        at: centre of the window, as shares of width and height. The window is moved so that it lies in the picture.
        settings: ``window_side``.
    """
    scale = side / max(view.width, view.height)
    whole = [max(1, round(scale * size)) for size in (view.width, view.height)]
    part = [min(1.0, settings.window_side / max(whole)) * size for size in whole]
    size = [max(1, round(length)) for length in part]
    first = [
        min(max(round(share * full - 0.5 * own), 0), full - own)
        for share, full, own in zip(at, whole, size, strict=True)
    ]
    K = view.K.clone()
    K[0] *= whole[0] / view.width
    K[1] *= whole[1] / view.height
    K[0, 2] -= first[0]
    K[1, 2] -= first[1]
    return replace(view, K=K, width=size[0], height=size[1])


def windows_of(
    views: Views,
    alphas: Sequence[Tensor],
    sides: Sequence[int] | None = None,
    seed: int = 0,
    settings: LookingSettings = DEFAULTS,
    each: int = 1,
) -> Windows:
    """Windows of each view at each side; where a window holds the whole picture, it is one.

    Args:
        views: C views of any size.
        alphas: C alpha pictures (h, w) of the scene, of any size: the centres of windows are drawn by alpha.
        sides: longer sides of the whole pictures, pixels; by default :func:`sides_of`.
        seed: seed of the positions of the windows.
        settings: ``window_side``.
        each: number of windows of each view.
    """
    generator = random.Random(seed)
    pairs = [pair for pair in zip(views, alphas, strict=True) for _ in range(each)]
    sides = tuple(sides or sides_of(views.width, views.height, settings))

    def of_side(side: int) -> Views:
        found = [window(view, side, _drawn_position(alpha, generator), settings) for view, alpha in pairs]
        if side <= settings.window_side:
            found = found[::each]
        viewmats, Ks = (torch.stack(some) for some in zip(*((view.viewmat, view.K) for view in found), strict=True))
        return replace(views, viewmats=viewmats, Ks=Ks, width=found[0].width, height=found[0].height)

    return Windows(sides, tuple(map(of_side, sides)))


def _drawn_position(alpha: Tensor, generator: random.Random) -> tuple[float, float]:
    """A position in a picture, as shares of width and height, drawn by alpha (h, w); the middle if alpha is 0."""
    weights = alpha.double().flatten().cumsum(0)
    if not 0 < float(weights[-1]) < math.inf:
        return 0.5, 0.5
    drawn = torch.tensor(generator.random(), dtype=torch.float64) * weights[-1]
    row, column = divmod(min(int(torch.searchsorted(weights, drawn)), len(weights) - 1), alpha.shape[1])
    return (column + 0.5) / alpha.shape[1], (row + 0.5) / alpha.shape[0]


class WindowRenders:
    """Renders of a dense scene in windows, with which renders of other scenes are compared before two backgrounds.

    Args:
        dense: N Gaussians.
        views: C views of the scene.
        sides: as for :func:`windows_of`.
        seed: seed of the positions of the windows.
        settings: those of windows.
        each: number of windows of each view.
    """

    @torch.no_grad()
    def __init__(
        self,
        dense: Gaussians,
        views: Views,
        sides: Sequence[int] | None = None,
        seed: int = 0,
        settings: LookingSettings = DEFAULTS,
        each: int = 1,
    ):
        small = list(views.resized(settings.window_alpha_side))
        alphas = list(each_view(small, len(dense), lambda view: render_with_alpha(dense, view)[1][..., 0], settings))
        windows = windows_of(views, alphas, sides, seed, settings, each)
        self.references = [DenseReference(dense, of_side, both_backgrounds=True) for of_side in windows.views]
        """Renders of the dense scene, for each side."""

    def psnrs(self, scene: Gaussians) -> list[float]:
        """PSNR for each side, dB; at most :data:`~pointsplat_ns.metrics.MOST_PSNR`."""
        return [min(reference.psnr(scene)[0], MOST_PSNR) for reference in self.references]

    def psnr(self, scene: Gaussians) -> float:
        """Mean of :meth:`psnrs` over the sides, dB."""
        found = self.psnrs(scene)
        return sum(found) / len(found)
