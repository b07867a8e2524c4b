"""The largest scene whose compressed file stays within a size. How well a scene compresses shows only when it is
written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io.formats import Format
from pointsplat_ns.system.progress import silent

CLOSE = 0.95
"""A file of at least this share of the limit is large enough."""

TRIES = 3
"""Counts that are tried, at most, for as long as one of them fits; each makes the scene anew."""

_BELOW = 0.99
"""Share of the limit that is aimed at, so that the first guess rarely lies above."""


@dataclass(frozen=True, eq=False)
class FoundSize:
    """The result of the search."""

    scene: Gaussians
    size: int
    """Bytes of its file."""
    tried: dict[int, int]
    """Bytes by count, for every count tried."""


def largest_within(
    full: Gaussians,
    make: Callable[[int], Gaussians],
    kind: Format,
    limit: int,
    progress: Callable[[float], None],
) -> FoundSize:
    """Search for a scene whose file has at most ``limit`` bytes, and not much less.

    The next count follows from the bytes per Gaussian of the last one. The result has been encoded and fits.

    Args:
        full: N Gaussians; if all fit, they are kept.
        make: from a count K to a scene of K Gaussians.
        kind: a format whose size depends on the scene.
        limit: bytes.
        progress: called with the share done, in [0, 1].

    Raises:
        BudgetError: if not even one Gaussian fits.
    """
    n = len(full)
    tried: dict[int, int] = {}
    best: FoundSize | None = None
    count, size = n, _size(full, kind)
    low, high = 0, n + 1  # a count that fits, and one that does not
    scene = full
    while True:
        tried[count] = size
        if size <= limit:
            low = count
            best = FoundSize(scene, size, tried)
            if size >= CLOSE * limit or count == n or len(tried) >= TRIES:
                return best
        else:
            high = min(high, count)
            if best is not None and len(tried) >= TRIES:
                return best
        count = min(max(int(_BELOW * count * limit / size), low + 1), high - 1)
        if count <= low:
            if best is None:
                raise BudgetError(
                    f"keep is {limit / 1e6:g}MB{kind.suffix}, too small for one Gaussian; expected at least "
                    f"{tried[1] / 1e6:g}MB"
                )
            return best
        progress(min(len(tried) / (TRIES + 1), 1.0))
        scene = make(count)
        size = _size(scene, kind)


def _size(scene: Gaussians, kind: Format) -> int:
    """Bytes of a scene's file, which leaves out what cannot be drawn."""
    assert kind.encode is not None
    scene = scene.detach().to("cpu", torch.float32)
    return len(kind.encode(scene[scene.usable()], silent))
