"""Schedules of learning rates."""

from __future__ import annotations

import math


def cosine_factor(done: float, last: float) -> float:
    """Factor on a learning rate when a share of the steps, ``done`` in [0, 1], is done: half a
    cosine that falls from 1 to ``last``.

    Example:
        >>> [round(cosine_factor(done, 0.1), 3) for done in (0.0, 0.5, 1.0)]
        [1.0, 0.55, 0.1]
    """
    return last + (1 - last) * 0.5 * (1 + math.cos(math.pi * done))
