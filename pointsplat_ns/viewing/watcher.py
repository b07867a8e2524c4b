"""One open page of the viewer: what it looks at, and the newest picture of it."""

from __future__ import annotations

import io
import threading
import time
from dataclasses import dataclass

import numpy as np

from pointsplat_ns.viewing.painter import Painter, PictureRequest
from pointsplat_ns.viewing.schedule import Step

MOVING_QUALITY, RESTING_QUALITY = 75, 95
"""JPEG quality of pictures while the camera moves, and at rest."""


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

    def _show(self, pixels: np.ndarray, step: Step[PictureRequest], seconds: float) -> None:
        from PIL import Image

        stream = io.BytesIO()
        preview = step.moving and not step.whole
        quality, sampling = (MOVING_QUALITY, 2) if preview else (RESTING_QUALITY, 0)
        Image.fromarray(pixels).save(stream, format="JPEG", quality=quality, subsampling=sampling)
        with self._changed:
            look = self._look if step.whole and step.number == self._looks else -1
            self._shown = Shown(self._shown.number + 1, stream.getvalue(), look)
            self._changed.notify_all()
