"""Pictures of several sizes, drawn in few pixels.

3DGS adds 0.3 pixels^2 to the covariance of every projected Gaussian. So a scene that is right in
small pictures may be wrong in large ones, and the other way around. Nothing else in a pixel depends
on the size of the picture: every k-th pixel of a large picture is the picture of k times fewer
pixels a side, with 0.3 / k^2 in place of 0.3. Such a subsampled picture covers all that the large
one shows, at the cost of the small one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.metrics import MOST_PSNR
from pointsplat_ns.rendering.comparison.closeness import DenseReference
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.views import Views

RESOLUTION = (1920, 1080)
"""Width and height of sampled views, pixels: the size that most people look at."""

SMALLEST_SIDE = 320
"""Longer side of the smallest picture, and of subsampled ones, pixels."""

NEARER = 4
"""Size of the pictures that stand for nearer cameras, in units of the whole size."""


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
    if len(parts) != 2 or not all(
        part.strip().isdecimal() and 1 <= int(part) <= 16384 for part in parts
    ):
        raise PointSplatError(
            f"resolution is {text!r}; expected width and height in pixels, such as 1920x1080"
        )
    return int(parts[0]), int(parts[1])


def size_text(resolution: tuple[int, int]) -> str:
    """A width and height as :func:`parse_resolution` reads them."""
    return "x".join(map(str, resolution))


def sides_of(width: int, height: int) -> tuple[int, ...]:
    """Longer sides of the pictures that renders are compared in, pixels: :data:`SMALLEST_SIDE`, the
    whole size, and their geometric mean. The whole size alone if it is no larger than the smallest.

    Example:
        >>> sides_of(1920, 1080), sides_of(540, 360), sides_of(64, 48)
        ((320, 784, 1920), (320, 416, 540), (64,))
    """
    longest = max(width, height)
    smallest = SMALLEST_SIDE
    return (
        (longest,)
        if longest <= smallest
        else (smallest, round(math.sqrt(smallest * longest)), longest)
    )


def middle_side(views: Views) -> int:
    """The middle one of the :func:`sides_of` views, pixels."""
    sides = sides_of(views.width, views.height)
    return sides[len(sides) // 2]


def middle_sized(views: Views) -> Views:
    """Views at their :func:`middle_side`: nearly as large as people look at, and quick to draw."""
    return views.resized(middle_side(views))


def subsampled(views: Views, side: int, drawn_side: int | None = None) -> Views:
    """Every k-th pixel of pictures of another size, k = ``side / drawn_side``.

    Args:
        views: C views of any size.
        side: longer side of the whole pictures, pixels. If it is larger than the views' own, the
            pictures are as large as those of a camera that is nearer.
        drawn_side: longer side of what is drawn, pixels; at most that of ``views``. By default
            ``side``, and at most :data:`SMALLEST_SIDE`.
    """
    drawn = views.resized(min(side, SMALLEST_SIDE) if drawn_side is None else drawn_side)
    return replace(drawn, eps2d=views.eps2d * (max(drawn.width, drawn.height) / side) ** 2)


def several_sizes(views: Views, drawn_side: int = SMALLEST_SIDE) -> tuple[Views, Views, Views]:
    """Views to optimise on, subsampled from pictures of three sizes: their :func:`middle_side`,
    their whole size, and :data:`NEARER` times that. By default, drawn pictures are no larger than
    the smallest: many views teach more than many pixels of few. Without the third, a garden gains
    0.2 dB less at 1920 pixels, and as much at 960."""
    whole = max(views.width, views.height)
    sides = middle_side(views), whole, NEARER * whole
    middle, full, nearer = (subsampled(views, side, min(side, whole, drawn_side)) for side in sides)
    return middle, full, nearer


class RendersOfSizes:
    """Renders of a dense scene, subsampled from pictures of several sizes, with which renders of
    other scenes are compared over two backgrounds.

    Args:
        dense: N Gaussians.
        views: C views of the scene.
        sides: longer sides of the whole pictures, pixels.
    """

    @torch.no_grad()
    def __init__(self, dense: Gaussians, views: Views, sides: Sequence[int]):
        drawn = [subsampled(views, side) for side in sides]
        self.references = [
            DenseReference(dense, of_side, both_backgrounds=True) for of_side in drawn
        ]
        """Renders of the dense scene, for each side."""

    def psnrs(self, scene: Gaussians) -> list[float]:
        """PSNR for each side, dB; at most :data:`~pointsplat_ns.metrics.MOST_PSNR`."""
        return [min(reference.psnr(scene)[0], MOST_PSNR) for reference in self.references]

    def psnr(self, scene: Gaussians) -> float:
        """Mean of :meth:`psnrs` over the sides, dB."""
        found = self.psnrs(scene)
        return sum(found) / len(found)
