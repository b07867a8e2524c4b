"""One factor for the sizes of all merged Gaussians, chosen by renders.

How large a merged Gaussian must be to look like its members depends on how these overlap and on what is behind them,
and differs between scenes. The factor is chosen by the PSNR against the dense scene in pictures of the
middle size (:func:`~pointsplat_ns.comparing.sizes.sides_of`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True)
class Finish:
    """The change of the sizes of merged Gaussians."""

    size_change: float = 0.0
    """Added to the log-scales of merged Gaussians."""
    psnr: float | None = None
    """PSNR against the dense scene's renders, dB; None if nothing was rendered."""
    psnr_before: float | None = None
    """The same with a size change of 0, dB."""

    @property
    def note(self) -> str:
        """One line of text: the factor, and its gain."""
        factor = f"sizes of merged Gaussians x {math.exp(self.size_change):.3f}"
        if self.psnr is None or self.psnr_before is None:
            return f"{factor}, by default"
        return f"{factor}, chosen by renders: {self.psnr_before:.2f} -> {self.psnr:.2f} dB"


def best_finish(psnr_of: Callable[[float], float]) -> Finish:
    """The best size change of those tried: three, and the top of the parabola through them, a little outside of them at
    most. ``psnr_of`` gives the PSNR of the scene with a size change, dB."""
    changes = (-0.1, 0.0, 0.05)
    tried = {change: psnr_of(change) for change in changes}
    top = top_of_parabola(changes, list(tried.values()), margin=0.05)
    tried[top] = psnr_of(top)
    best = max(tried, key=lambda change: tried[change])
    return Finish(best, psnr=tried[best], psnr_before=tried[0.0])


def top_of_parabola(at: tuple[float, float, float], values: list[float], margin: float) -> float:
    """Where the parabola through three points is highest, at most ``margin`` outside of them. If it has no top, as far
    out if the values only rise that way, else the best of the three.

    Example:
        >>> round(top_of_parabola((0.0, 1.0, 3.0), [-4.0, -1.0, -1.0], margin=0.0), 6)
        2.0
    """
    (a, b, c), (p, q, r) = at, values
    left, right = (q - p) / (b - a), (r - q) / (c - b)
    bend = (right - left) / (c - a)
    if bend >= 0 and left * right > 0:
        return c + margin if right > 0 else a - margin
    if bend >= 0 or bend != bend:
        return at[max(range(3), key=lambda index: values[index])]
    top = 0.5 * (a + b) - 0.5 * left / bend
    return min(max(top, a - margin), c + margin)
