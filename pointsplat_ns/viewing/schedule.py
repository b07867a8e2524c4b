"""What to draw next for somebody who moves a camera: small and quick while it moves, whole once it is still.

Nothing here draws, sleeps or knows a camera: who draws asks for steps, and says how long each took.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

R = TypeVar("R")

MOVING_SIDE = 240
"""Smallest longer side while the camera moves. If that is too slow, Gaussians are left out."""

LEAST_SHARE = 0.05
"""Smallest share of the Gaussians drawn while the camera moves."""

MOVING_SECONDS = 0.15
"""How long a picture should take while the camera moves."""

REST_SECONDS = 0.3
"""How long a camera has to be still before the whole picture is begun."""


@dataclass(frozen=True)
class Step(Generic[R]):
    """A picture to draw."""

    request: R
    number: int
    """Of the request, ascending."""
    side: int
    """Longer side of the picture, pixels."""
    share: float
    """Share of the Gaussians to draw, in (0, 1]."""
    moving: bool
    """Whether it is quick enough for a camera that moves. It is then drawn to its end even if a newer request comes, as
    nothing would ever be seen otherwise."""
    whole: bool
    """Whether it is the whole picture, with all Gaussians. One that is quick enough for a moving camera may be."""


class Schedule(Generic[R]):
    """The steps from the newest request to its whole picture. May be used from several threads; one draws.

    Args:
        full_side: longer side of the whole picture, pixels.
        clock: gives seconds.
    """

    def __init__(self, full_side: int = 960, clock: Callable[[], float] = time.monotonic):
        self._full_side, self._clock = full_side, clock
        self._changed = threading.Condition()
        self._request: R | None = None
        self._number = 0
        self._asked = 0.0
        self._drawn = 0
        """Longer side of what has been drawn of the newest request; 0 for nothing."""
        self._complete = True
        self._closed = False
        self._effort = 0.1
        """Share of the work of the whole picture that is done while the camera moves."""

    def submit(self, request: R, full_side: int | None = None) -> None:
        """Draw this from now on, and nothing that was asked for before."""
        with self._changed:
            self._full_side = full_side or self._full_side
            self._request, self._number, self._asked = request, self._number + 1, self._clock()
            self._drawn, self._complete = 0, False
            self._changed.notify_all()

    def close(self) -> None:
        """End: :meth:`next` gives None, and every step is outdated."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def next(self, timeout: float | None = None) -> Step[R] | None:
        """The next step to draw; waits until there is one.

        Args:
            timeout: seconds to wait at most; by default without end.

        Returns:
            None if the time is over, or the schedule was closed.
        """
        end = None if timeout is None else time.monotonic() + timeout
        with self._changed:
            while not self._closed:
                wait = None
                if not self._complete:
                    wait = self._asked + REST_SECONDS - self._clock() if self._drawn else 0.0
                    if wait <= 0:
                        return self._step()
                left = None if end is None else end - time.monotonic()
                if left is not None and left <= 0:
                    return None
                waits = [seconds for seconds in (wait, left) if seconds is not None]
                self._changed.wait(min(waits) if waits else None)
            return None

    def outdated(self, step: Step[R]) -> bool:
        """Whether to stop drawing a step."""
        return self._closed or (step.number != self._number and not step.moving)

    def done(self, step: Step[R], seconds: float) -> None:
        """Say that a step was drawn, and how long it took."""
        with self._changed:
            if step.moving:
                low, high = (0.2, 1.5)  # least and largest change from one picture to the next
                change = math.sqrt(MOVING_SECONDS / max(seconds, 1e-3))  # by the root, so that it does not swing
                self._effort = min(max(self._effort * min(max(change, low), high), self._least()), 1.0)
            if step.number == self._number:
                self._drawn = step.side
                self._complete = step.whole
            self._changed.notify_all()

    def _moving_side(self) -> int:
        return min(MOVING_SIDE, self._full_side)

    def _least(self) -> float:
        """The smallest effort: the smallest side, and the smallest share of the Gaussians."""
        return (self._moving_side() / self._full_side) ** 2 * LEAST_SHARE

    def _step(self) -> Step[R]:
        assert self._request is not None
        full, smallest = self._full_side, self._moving_side()
        if self._drawn == 0:
            side = min(max(round(full * math.sqrt(self._effort)), smallest), full)
            share = max(min(self._effort / (smallest / full) ** 2, 1.0), LEAST_SHARE)
            return Step(self._request, self._number, side, share, moving=True, whole=side == full and share == 1.0)
        # A picture of a size between comes first if the whole one is more than four times as large as the first.
        side = full if full <= 4.0 * self._drawn or self._drawn > smallest else round(math.sqrt(full * smallest))
        return Step(self._request, self._number, side, 1.0, moving=False, whole=side == full)
