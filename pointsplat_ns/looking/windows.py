"""Windows of pictures at the size that people look at.

3DGS rasterizers widen every projected Gaussian by 0.3 pixels, so a scene that is right in small pictures may be wrong
in large ones, and the other way around. A window is a part of a picture at one of several sizes, from small to full. It
costs as much as a small picture of as many pixels, and is a crop of the large picture.
"""

from __future__ import annotations

import math
import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.each_view import each_view
from pointsplat_ns.looking.settings import DEFAULTS, LookingSettings
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
    views: tuple[tuple[View, ...], ...]
    """Windows for each side, one of each view."""

    def flat(self) -> list[View]:
        """All windows, one size after the other."""
        return [view for views in self.views for view in views]


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
) -> Windows:
    """One window of each view at each side; at the smallest side it is the whole picture.

    Args:
        views: C views of any size.
        alphas: C alpha pictures (h, w) of the scene, of any size: the centres of windows are drawn by alpha.
        sides: longer sides of the whole pictures, pixels; by default :func:`sides_of`.
        seed: seed of the positions of the windows.
        settings: ``window_side``.
    """
    generator = random.Random(seed)
    sides = tuple(sides or sides_of(views.width, views.height, settings))
    return Windows(
        sides,
        tuple(
            tuple(
                window(view, side, _drawn_position(alpha, generator), settings)
                for view, alpha in zip(views, alphas, strict=True)
            )
            for side in sides
        ),
    )


def _drawn_position(alpha: Tensor, generator: random.Random) -> tuple[float, float]:
    """A position in a picture, as shares of width and height, drawn by alpha (h, w); the middle if alpha is 0."""
    weights = alpha.double().flatten().cumsum(0)
    if not 0 < float(weights[-1]) < math.inf:
        return 0.5, 0.5
    drawn = torch.tensor(generator.random(), dtype=torch.float64) * weights[-1]
    row, column = divmod(min(int(torch.searchsorted(weights, drawn)), len(weights) - 1), alpha.shape[1])
    return (column + 0.5) / alpha.shape[1], (row + 0.5) / alpha.shape[0]


class WindowRenders:
    """Renders of a dense scene in windows, with which renders of other scenes are compared.

    Errors are means over two backgrounds, the views' own and its opposite (white for black): nobody knows before which
    one a scene is shown, and a scene that fits one may be too transparent or too opaque for the other.

    Args:
        dense: N Gaussians.
        views: C views of the scene.
        sides: as for :func:`windows_of`.
        seed: seed of the positions of the windows.
        settings: those of windows, and ``max_count_at_once``.
    """

    @torch.no_grad()
    def __init__(
        self,
        dense: Gaussians,
        views: Views,
        sides: Sequence[int] | None = None,
        seed: int = 0,
        settings: LookingSettings = DEFAULTS,
    ):
        self._settings = settings
        small = self._rendered(dense, list(views.resized(settings.window_alpha_side)))
        self.windows = windows_of(views, [alpha[..., 0] for _, alpha in small], sides, seed, settings)
        self.renders = list(self._rendered(dense, self.windows.flat()))
        self._other = (1 - 2 * views.background).to(dense.means)  # from a background to its opposite
        per_side = len(views)
        self.covered = [
            covered_share([alpha for _, alpha in self.renders[i * per_side : (i + 1) * per_side]])
            for i in range(len(self.windows.sides))
        ]
        """Share of the pixels that the dense scene covers, for each side, in [0, 1]."""

    @torch.no_grad()
    def errors(self, scene: Gaussians) -> list[list[float]]:
        """Mean squared error of each window, for each side."""
        pictures = self._rendered(scene, self.windows.flat())
        errors = []
        for (image, alpha), (target, covered) in zip(pictures, self.renders, strict=True):
            apart = image.double() - target.double()
            over_other = apart - (alpha - covered).double() * self._other
            errors.append(0.5 * (mean_square(apart) + mean_square(over_other)))
        count = len(self.windows.views[0])
        return [errors[i : i + count] for i in range(0, len(errors), count)]

    def _rendered(self, scene: Gaussians, views: Sequence[View]) -> Iterator[tuple[Tensor, Tensor]]:
        """Image (H, W, 3) and alpha (H, W, 1) of each view."""
        return each_view(views, len(scene), lambda view: render_with_alpha(scene, view), self._settings)

    def psnrs(self, scene: Gaussians) -> list[float]:
        """PSNR over the pixels that the dense scene covers, for each side, dB; at most 100."""
        return [
            psnr_of(sum(errors) / len(errors), covered)
            for errors, covered in zip(self.errors(scene), self.covered, strict=True)
        ]

    def psnr(self, scene: Gaussians) -> float:
        """Mean of :meth:`psnrs` over the sides, dB."""
        found = self.psnrs(scene)
        return sum(found) / len(found)


def mean_square(differences: Tensor) -> float:
    """Mean squared error, float64, of the differences between two pictures."""
    return float(differences.double().square().mean())


def covered_share(alphas: Sequence[Tensor]) -> float:
    """Share of the pixels that a scene covers, in [0, 1]: the mean of its ``alphas`` (H, W, 1), all of one size."""
    return sum(float(alpha.double().mean()) for alpha in alphas) / len(alphas)


def psnr_of(error: float, covered: float = 1.0) -> float:
    """PSNR over the pixels that the dense scene covers, dB, at most 100: empty background does not make it better.

    Args:
        error: mean squared error over all pixels.
        covered: share of the pixels that the dense scene covers, in [0, 1].
    """
    if not error > 1e-10 * (covered or 1.0):
        return math.nan if error != error else 100.0
    return -10 * math.log10(error / (covered or 1.0))
