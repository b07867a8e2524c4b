"""Chooses the next picture for a viewer: small and quick while the camera moves, full size once it is still.

The schedule does not draw and knows no camera. The drawing thread takes steps and reports their durations.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

Request = TypeVar("Request")


@dataclass(frozen=True)
class ScheduleSettings:
    """Settings of the schedule."""

    moving_side: int = 240
    """Smallest longer side of pictures while the camera moves, pixels. If that is too slow, Gaussians are left out."""
    least_share: float = 0.05
    """Smallest share of the Gaussians in pictures while the camera moves."""
    moving_seconds: float = 0.15
    """Target duration of a picture while the camera moves."""
    rest_seconds: float = 0.3
    """Time without motion before the full picture starts."""


SCHEDULE = ScheduleSettings()


@dataclass(frozen=True)
class DrawingStep(Generic[Request]):
    """A picture to draw."""

    request: Request
    number: int
    """Number of the request, ascending."""
    side: int
    """Longer side of the picture, pixels."""
    share: float
    """Share of the Gaussians to draw, in (0, 1]."""
    moving: bool
    """Whether the camera may be moving. Such a step is drawn to its end even after a newer request, because otherwise a
    moving camera would get no picture."""
    whole: bool
    """Whether it is the picture of full size with all Gaussians. A step of a moving camera may be that too."""


class Schedule(Generic[Request]):
    """The steps from the newest request to its full picture, whose longer side has ``full_side`` pixels. Several
    threads may use it; one of them draws."""

    def __init__(self, full_side: int = 960, clock: Callable[[], float] = time.monotonic):
        self._full_side, self._clock = full_side, clock
        self._changed = threading.Condition()
        self._request: Request | None = None
        self._number = 0
        self._asked = 0.0
        self._drawn = 0
        """Longer side of the last picture of the newest request; 0 if there is none."""
        self._complete = True
        self._closed = False
        self._effort = 0.1
        """Share of the full picture's work in a picture of a moving camera."""

    def submit(self, request: Request, full_side: int | None = None) -> None:
        """Replace the request; ``full_side`` may change the size of the full picture."""
        with self._changed:
            self._full_side = full_side or self._full_side
            self._request, self._number, self._asked = request, self._number + 1, self._clock()
            self._drawn, self._complete = 0, False
            self._changed.notify_all()

    def close(self) -> None:
        """End: :meth:`next` returns None, and every step is outdated."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def next(self, timeout: float | None = None) -> DrawingStep[Request] | None:
        """The next step to draw; waits until there is one, at most ``timeout`` seconds. None after that, or if the
        schedule is closed."""
        end = None if timeout is None else time.monotonic() + timeout
        with self._changed:
            while not self._closed:
                wait = None
                if not self._complete:
                    wait = self._asked + SCHEDULE.rest_seconds - self._clock() if self._drawn else 0.0
                    if wait <= 0:
                        return self._step()
                left = None if end is None else end - time.monotonic()
                if left is not None and left <= 0:
                    return None
                waits = [seconds for seconds in (wait, left) if seconds is not None]
                self._changed.wait(min(waits) if waits else None)
            return None

    def outdated(self, step: DrawingStep[Request]) -> bool:
        """Whether to stop drawing a step."""
        return self._closed or (step.number != self._number and not step.moving)

    def done(self, step: DrawingStep[Request], seconds: float) -> None:
        """Report that a step was drawn, and its duration."""
        with self._changed:
            if step.moving:
                low, high = (0.2, 1.5)  # least and largest factor from one picture to the next
                change = math.sqrt(SCHEDULE.moving_seconds / max(seconds, 1e-3))  # the root prevents oscillation
                self._effort = min(max(self._effort * min(max(change, low), high), self._least()), 1.0)
            if step.number == self._number:
                self._drawn = step.side
                self._complete = step.whole
            self._changed.notify_all()

    def _moving_side(self) -> int:
        return min(SCHEDULE.moving_side, self._full_side)

    def _least(self) -> float:
        """The smallest effort: the smallest side, and the smallest share of the Gaussians."""
        return (self._moving_side() / self._full_side) ** 2 * SCHEDULE.least_share

    def _step(self) -> DrawingStep[Request]:
        assert self._request is not None
        full, smallest = self._full_side, self._moving_side()
        if self._drawn == 0:
            side = min(max(round(full * math.sqrt(self._effort)), smallest), full)
            share = max(min(self._effort / (smallest / full) ** 2, 1.0), SCHEDULE.least_share)
            return DrawingStep(
                self._request, self._number, side, share, moving=True, whole=side == full and share == 1.0
            )
        # A picture of a middle size comes first if the full side is more than four times the side of the last picture.
        side = full if full <= 4.0 * self._drawn or self._drawn > smallest else round(math.sqrt(full * smallest))
        return DrawingStep(self._request, self._number, side, 1.0, moving=False, whole=side == full)
