"""Draws the frames of a film of one scene, or of two in one picture, with a line between them and labels."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer.constants import TILE
from pointsplat_ns.rasterizer.drawing import Drawing
from pointsplat_ns.rasterizer.rendering import QualityName
from pointsplat_ns.rasterizer.tiles import Region
from pointsplat_ns.views import View, Views

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont


SplitScreen = Literal["side-by-side", "wipe"]


@dataclass(frozen=True, eq=False)
class FilmScenes:
    """Scenes of a film, and their layout in the picture."""

    first: Gaussians
    second: Gaussians | None = None
    split: SplitScreen = "side-by-side"
    labels: Sequence[str] = ()
    """Labels of the first and the second scene; may be empty."""


def render_frames(film: FilmScenes, views: Views, fps: float) -> Iterator[np.ndarray]:
    """Draw the frames (H, W, 3) uint8 of a film; twice as wide as the views if two scenes are side by side."""
    for index, view in enumerate(views):
        yield render_frame(film, view, index / fps)


@torch.no_grad()
def render_frame(film: FilmScenes, view: View, seconds: float = 0.0) -> np.ndarray:
    """Draw one frame (H, W, 3) uint8; the time places the line of a wipe."""
    if film.second is not None and film.split == "wipe":
        # The line moves 0.4 of the width to one side of the middle, to the other side, and back within 6 s.
        at = 0.5 + 0.4 * math.sin(2 * math.pi * seconds / 6.0)
        column = round(at * view.width)
        pictures = [Wipe(film.first, film.second, view, column)]
    else:
        scenes = [film.first] if film.second is None else [film.first, film.second]
        pictures = [Wipe(scene, None, view) for scene in scenes]
        column = view.width
    pixels = np.concatenate([to_uint8(picture.draw(0, picture.rows)) for picture in pictures], axis=1)
    if film.second is not None:
        pixels = with_line(pixels, column)
    return with_labels(pixels, film.labels, column) if film.labels else pixels


class Wipe:
    """The picture of one or two scenes in one view: the first left of a column (in pixels, from 0 to the view's width),
    the second, if there is one, from there on. Hidden parts of a scene are not drawn."""

    def __init__(
        self,
        first: Gaussians,
        second: Gaussians | None,
        view: View,
        column: int = 0,
        quality: QualityName = "exact",
    ):
        self.column = view.width if second is None else min(max(column, 0), view.width)
        """First column of the second scene, pixels."""
        self._first = Drawing(first, view, quality) if self.column > 0 else None
        self._second = None
        if second is not None and self.column < view.width:
            self._second = Drawing(second, view, quality)
        self.rows = -(-view.height // TILE)
        """Rows of tiles of 8 pixels."""

    def draw(self, top: int, bottom: int) -> Tensor:
        """Rows ``top`` to ``bottom`` - 1 of tiles, colours in [0, 1]: (h, width, 3)."""
        parts = []
        if self._first is not None:
            end = -(-self.column // TILE)
            parts.append(self._first.draw(Region(top, bottom, 0, end))[:, : self.column])
        if self._second is not None:
            begin = self.column // TILE
            part = self._second.draw(Region(top, bottom, begin, self._second.columns))
            parts.append(part[:, self.column - begin * TILE :])
        return torch.cat(parts, dim=1)


def to_uint8(picture: Tensor) -> np.ndarray:
    """A picture (H, W, 3) in [0, 1] as uint8."""
    return (255 * picture.clamp(0, 1)).round().to(torch.uint8).cpu().numpy()


def with_line(pixels: np.ndarray, column: int) -> np.ndarray:
    """A picture (H, W, 3) uint8 with a thin line before a column: white with dark sides, so that it is visible on
    white. There is no line at the ends of the picture."""
    if not 0 < column < pixels.shape[1]:
        return pixels
    pixels = pixels.copy()
    thick = 2 if pixels.shape[1] >= 640 else 1
    left = column - thick // 2
    pixels[:, max(left - 1, 0) : left + thick + 1] //= 3
    pixels[:, left : left + thick] = 255
    return pixels


def with_labels(pixels: np.ndarray, labels: Sequence[str], column: int) -> np.ndarray:
    """A picture (H, W, 3) uint8 with labels on dark ground, at the top left and the top right.

    A label is shortened to half of the picture, and left out if its side of ``column`` is too narrow.
    """
    from PIL import Image, ImageDraw

    height, width = pixels.shape[:2]
    size = max(round(0.03 * height), 11)  # pixels
    image = Image.fromarray(pixels)
    draw = ImageDraw.Draw(image, "RGBA")
    font, pad = _font(size), size // 2
    for index, label in enumerate(labels):
        text = _shortened(label, font, width // len(labels) - 4 * pad)
        long = int(font.getlength(text))
        room = column if index == 0 else width - column
        if not text or long + 3 * pad > room:
            continue
        left = pad if index == 0 else width - long - 3 * pad
        draw.rectangle((left, pad, left + long + 2 * pad, 2 * pad + size + pad // 2), fill=(0, 0, 0, 150))
        draw.text((left + pad, pad + pad // 2), text, font=font, fill=(255, 255, 255, 255))
    return np.asarray(image)


@functools.lru_cache(4)
def _font(size: int) -> FreeTypeFont:
    import matplotlib
    from PIL import ImageFont

    # This font has the letters of most languages; Pillow's has Latin ones only.
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size)


def _shortened(text: str, font: FreeTypeFont, longest: int) -> str:
    """The text with its end replaced by dots if it is wider than ``longest`` pixels; empty if no letter fits."""
    text = " ".join(text.split())
    if font.getlength(text) <= longest:
        return text
    while text and font.getlength(text + "...") > longest:
        text = text[:-1]
    return text and text + "..."
