"""Draws the frames of a film of one scene, or of two in one picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.viewing.split_screen import Wipe, pixels_of, with_labels, with_line
from pointsplat_ns.views import RasterizeMode, View, Views

Split = Literal["side-by-side", "wipe"]


@dataclass(frozen=True, eq=False)
class Cast:
    """Scenes of a film, and how they share the picture."""

    first: Gaussians
    second: Gaussians | None = None
    modes: tuple[RasterizeMode, RasterizeMode] = ("classic", "classic")
    """The rasterize modes of both."""
    split: Split = "side-by-side"
    labels: Sequence[str] = ()
    """Of the first and the second; none are written if there are none."""


def frames_of(cast: Cast, views: Views, fps: float) -> Iterator[np.ndarray]:
    """The frames (H, W, 3) uint8 of a film; twice as wide as the views if two scenes are side by side."""
    for index, view in enumerate(views):
        yield frame_of(cast, view, index / fps)


@torch.no_grad()
def frame_of(cast: Cast, view: View, seconds: float = 0.0) -> np.ndarray:
    """One frame (H, W, 3) uint8, at a time that places the line of a wipe."""
    if cast.second is not None and cast.split == "wipe":
        # To one side, 0.4 of the width from the middle, to the other and back within 6 s.
        at = 0.5 + 0.4 * math.sin(2 * math.pi * seconds / 6.0)
        column = round(at * view.width)
        pictures = [Wipe(cast.first, cast.second, view, column, cast.modes)]
    else:
        scenes = [cast.first] if cast.second is None else [cast.first, cast.second]
        modes = zip(cast.modes, cast.modes, strict=True)
        pictures = [Wipe(scene, None, view, modes=mode) for scene, mode in zip(scenes, modes, strict=False)]
        column = view.width
    pixels = np.concatenate([pixels_of(picture.draw(0, picture.rows)) for picture in pictures], axis=1)
    if cast.second is not None:
        pixels = with_line(pixels, column)
    return with_labels(pixels, cast.labels, column) if cast.labels else pixels
