"""Draws the frames of a film of one scene, or of two in one picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.viewing.split_screen import Wipe, to_uint8, with_labels, with_line
from pointsplat_ns.views import RasterizeMode, View, Views

Split = Literal["side-by-side", "wipe"]


@dataclass(frozen=True, eq=False)
class FilmScenes:
    """Scenes of a film, and their layout in the picture."""

    first: Gaussians
    second: Gaussians | None = None
    modes: tuple[RasterizeMode, RasterizeMode] = ("classic", "classic")
    """The rasterize modes of both scenes."""
    split: Split = "side-by-side"
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
        pictures = [Wipe(film.first, film.second, view, column, film.modes)]
    else:
        scenes = [film.first] if film.second is None else [film.first, film.second]
        modes = zip(film.modes, film.modes, strict=True)
        pictures = [Wipe(scene, None, view, modes=mode) for scene, mode in zip(scenes, modes, strict=False)]
        column = view.width
    pixels = np.concatenate([to_uint8(picture.draw(0, picture.rows)) for picture in pictures], axis=1)
    if film.second is not None:
        pixels = with_line(pixels, column)
    return with_labels(pixels, film.labels, column) if film.labels else pixels
