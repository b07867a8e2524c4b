"""Draws what a camera sees, band by band, on a thread of its own."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.io.files import logger, one_line
from pointsplat_ns.viewing.schedule import Schedule, Step
from pointsplat_ns.viewing.selection import ShownScene
from pointsplat_ns.viewing.split_screen import Wipe, pixels_of, with_line
from pointsplat_ns.views import RasterizeMode, View


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera whose pictures may have any size."""

    viewmat: Tensor  # [4, 4] float64, world to camera, OpenCV axes
    fov: float
    """From top to bottom, radians."""
    aspect: float
    """Width by height."""
    background: Tensor  # [3] in [0, 1]
    near_plane: float  # scene units

    def view(self, side: int) -> View:
        """The camera, with pictures whose longer side has so many pixels."""
        aspect = min(max(self.aspect, 0.05), 20.0)
        width, height = (side, round(side / aspect)) if aspect >= 1 else (round(side * aspect), side)
        width, height = max(width, 1), max(height, 1)
        focal = 0.5 * height / math.tan(0.5 * min(max(self.fov, 0.01), 3.1))
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
        return View(self.viewmat, K, width, height, self.background, near_plane=self.near_plane)


@dataclass(frozen=True, eq=False)
class Sight:
    """Request for a picture: camera, scenes and dividing line."""

    camera: Camera
    first: ShownScene
    second: ShownScene | None
    line: float
    """How much of the picture's width the first takes, in [0, 1]."""
    modes: tuple[RasterizeMode, RasterizeMode]


def paint(step: Step[Sight]) -> Iterator[np.ndarray | None]:
    """Draw a step band by band: None after each, and at last the picture (H, W, 3) uint8."""
    sight, view = step.request, step.request.camera.view(step.side)
    first = sight.first.part(step.share)
    second = None if sight.second is None or sight.line >= 1 else sight.second.part(step.share)
    column = round(sight.line * view.width)
    wipe = Wipe(first, second, view, column, sight.modes, "fast" if step.moving else "exact")
    yield None
    # 32,768 pixels, at least, between two looks at whether the camera has moved.
    bands, rows = [], max(32_768 // (8 * view.width), 1)
    for top in range(0, wipe.rows, rows):
        bands.append(wipe.draw(top, min(top + rows, wipe.rows)))
        yield None
    pixels = pixels_of(torch.cat(bands))
    yield pixels if second is None else with_line(pixels, wipe.column)


class Painter:
    """A thread that draws what a schedule asks for, until it is closed.

    Args:
        show: called with each picture that was drawn, its step, and the seconds that it took.
        paint: draws a step.
    """

    def __init__(
        self,
        show: Callable[[np.ndarray, Step[Sight], float], None],
        paint: Callable[[Step[Sight]], Iterator[np.ndarray | None]] = paint,
    ):
        self.schedule: Schedule[Sight] = Schedule()
        """What to draw."""
        self._show, self._paint = show, paint
        self._thread = threading.Thread(target=self._work, name="painting", daemon=True)
        self._thread.start()

    def close(self, timeout: float = 5.0) -> None:
        """Stop, and wait until the band in work is done, for so many seconds."""
        self.schedule.close()
        self._thread.join(timeout)

    def _work(self) -> None:
        while (step := self.schedule.next()) is not None:
            start = time.perf_counter()
            try:
                pixels = self._drawn(step)
            except (ValueError, RuntimeError) as error:  # a camera at no place, or too little memory
                logger.warning("cannot draw: %s", one_line(error))
                pixels = np.zeros((1, 1, 3), np.uint8)
            if pixels is not None:
                seconds = time.perf_counter() - start
                self.schedule.done(step, seconds)
                self._show(pixels, step, seconds)

    def _drawn(self, step: Step[Sight]) -> np.ndarray | None:
        """The picture of a step; None if it is not wanted any more."""
        pixels = None
        for part in self._paint(step):
            if self.schedule.outdated(step):
                return None
            pixels = part
        return pixels
