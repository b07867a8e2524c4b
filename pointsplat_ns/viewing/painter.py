"""Draws pictures for the open pages of the viewer, band by band, on a thread for each."""

from __future__ import annotations

import io
import math
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pointsplat_ns.io.files import logger, one_line
from pointsplat_ns.system.tensors import DOUBLES
from pointsplat_ns.viewing.film import Wipe, to_uint8, with_line
from pointsplat_ns.viewing.schedule import DrawingStep, Schedule
from pointsplat_ns.viewing.selection import ReducedScene
from pointsplat_ns.views import View


@dataclass(frozen=True, eq=False)
class ViewerCamera:
    """A camera without a size of pictures."""

    viewmat: Tensor  # [4, 4] float64, world to camera, OpenCV axes
    fov: float
    """Vertical field of view, radians."""
    aspect: float
    """Width over height."""
    background: Tensor  # [3] in [0, 1]
    near_plane: float  # scene units

    def view(self, side: int) -> View:
        """The camera with pictures whose longer side has ``side`` pixels."""
        aspect = min(max(self.aspect, 0.05), 20.0)
        width, height = (side, round(side / aspect)) if aspect >= 1 else (round(side * aspect), side)
        width, height = max(width, 1), max(height, 1)
        focal = 0.5 * height / math.tan(0.5 * min(max(self.fov, 0.01), 3.1))
        K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]], **DOUBLES)
        return View(self.viewmat, K, width, height, self.background, near_plane=self.near_plane)


@dataclass(frozen=True, eq=False)
class PictureRequest:
    """Request for a picture: camera, scenes and dividing line."""

    camera: ViewerCamera
    first: ReducedScene
    second: ReducedScene | None
    line: float
    """Share of the picture's width for the first scene, in [0, 1]."""


def paint(step: DrawingStep[PictureRequest]) -> Iterator[np.ndarray | None]:
    """Draw a step band by band: yield None after each band, and the picture (H, W, 3) uint8 at the end."""
    request, view = step.request, step.request.camera.view(step.side)
    first = request.first.part(step.share)
    second = None if request.second is None or request.line >= 1 else request.second.part(step.share)
    column = round(request.line * view.width)
    wipe = Wipe(first, second, view, column, "fast" if step.moving else "exact")
    yield None
    # At least 32,768 pixels between two checks for a moved camera.
    bands, rows = [], max(32_768 // (8 * view.width), 1)
    for top in range(0, wipe.rows, rows):
        bands.append(wipe.draw(top, min(top + rows, wipe.rows)))
        yield None
    pixels = to_uint8(torch.cat(bands))
    yield pixels if second is None else with_line(pixels, wipe.column)


class Painter:
    """A thread that draws the steps of a schedule, until it is closed. ``show`` is called with each picture, its step,
    and the seconds of drawing; ``paint`` draws a step."""

    def __init__(
        self,
        show: Callable[[np.ndarray, DrawingStep[PictureRequest], float], None],
        paint: Callable[[DrawingStep[PictureRequest]], Iterator[np.ndarray | None]] = paint,
    ):
        self.schedule: Schedule[PictureRequest] = Schedule()
        """The steps to draw."""
        self._show, self._paint = show, paint
        self._thread = threading.Thread(target=self._work, name="painting", daemon=True)
        self._thread.start()

    def close(self, timeout: float = 5.0) -> None:
        """Stop, and wait at most ``timeout`` seconds for the current band."""
        self.schedule.close()
        self._thread.join(timeout)

    def _work(self) -> None:
        while (step := self.schedule.next()) is not None:
            start = time.perf_counter()
            try:
                pixels = self._drawn(step)
            except (ValueError, RuntimeError) as error:  # an invalid camera, or too little memory
                logger.warning("cannot draw: %s", one_line(error))
                pixels = np.zeros((1, 1, 3), np.uint8)
            if pixels is not None:
                seconds = time.perf_counter() - start
                self.schedule.done(step, seconds)
                self._show(pixels, step, seconds)

    def _drawn(self, step: DrawingStep[PictureRequest]) -> np.ndarray | None:
        """The picture of a step; None if the step is outdated."""
        pixels = None
        for part in self._paint(step):
            if self.schedule.outdated(step):
                return None
            pixels = part
        return pixels


@dataclass(frozen=True)
class Shown:
    """The newest picture of a page."""

    number: int = 0
    """Ascending; 0 if there is none."""
    jpeg: bytes = b""
    look: int = -1
    """The request that it is the full picture of; -1 if it is not full, or not of the newest request."""


class Watcher:
    """Draws for one page, on a thread of its own, until it is closed."""

    def __init__(self) -> None:
        self.seen = time.monotonic()
        """When the page was heard of last."""
        self._changed = threading.Condition()
        self._shown, self._texts, self._closed = Shown(), 0, False
        self._looks, self._look = 0, -1
        self._painter = Painter(self._show)

    def look(self, request: PictureRequest, side: int, look: int) -> None:
        """Request a picture whose longer side has ``side`` pixels; ``look`` is the page's number of the request."""
        with self._changed:
            self._looks, self._look = self._looks + 1, look
            self._painter.schedule.submit(request, side)

    def next(self, number: int, texts: int, seconds: float) -> tuple[Shown, int]:
        """Wait for a picture other than ``number``, or for newer texts, at most some seconds: the newest picture, and
        the number of the newest texts."""
        with self._changed:
            self._changed.wait_for(
                lambda: self._closed or self._shown.number != number or self._texts != texts, seconds
            )
            return self._shown, self._texts

    def tell(self) -> None:
        """There are new texts."""
        with self._changed:
            self._texts += 1
            self._changed.notify_all()

    def close(self, timeout: float = 0.0) -> None:
        """Stop drawing, and wait for it at most ``timeout`` seconds."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._painter.close(timeout)

    def _show(self, pixels: np.ndarray, step: DrawingStep[PictureRequest], seconds: float) -> None:
        from PIL import Image

        stream = io.BytesIO()
        preview = step.moving and not step.whole
        quality, sampling = (75, 2) if preview else (95, 0)  # of JPEG
        Image.fromarray(pixels).save(stream, format="JPEG", quality=quality, subsampling=sampling)
        with self._changed:
            look = self._look if step.whole and step.number == self._looks else -1
            self._shown = Shown(self._shown.number + 1, stream.getvalue(), look)
            self._changed.notify_all()
