"""Draws the frames of a film of one scene, or of two in one picture, with a line between them and labels."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.rasterizer import render
from pointsplat_ns.views import View, Views

if TYPE_CHECKING:
    from PIL.ImageFont import FreeTypeFont


SplitScreen = Literal["side-by-side", "wipe"]


def render_frames(
    scenes: Sequence[Gaussians],
    views: Views,
    fps: float,
    split: SplitScreen = "side-by-side",
    labels: Sequence[str] = (),
) -> Iterator[np.ndarray]:
    """Draw the frames (H, W, 3) uint8 of a film of one scene or two. Two have ``labels``, unless these are empty."""
    for index, view in enumerate(views):
        if len(scenes) > 1 and split == "wipe":
            # The line moves 0.4 of the width to one side of the middle, to the other side, and back within 6 s.
            column = round((0.5 + 0.4 * math.sin(2 * math.pi * index / fps / 6.0)) * view.width)
            pixels = wiped(scenes, view, column)
        else:
            column = view.width
            with torch.no_grad():
                beside = np.concatenate([to_uint8(render(scene, view)) for scene in scenes], axis=1)
            pixels = with_line(beside, column)
        yield with_labels(pixels, labels, column) if labels else pixels


@torch.no_grad()
def wiped(scenes: Sequence[Gaussians], view: View, column: int) -> np.ndarray:
    """The picture (H, W, 3) uint8 of one scene, or of two: the first left of a column, a line, and the second."""
    first, *others = (to_uint8(render(scene, view)) for scene in scenes)
    return with_line(np.concatenate([first[:, :column], others[0][:, column:]], axis=1), column) if others else first


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
