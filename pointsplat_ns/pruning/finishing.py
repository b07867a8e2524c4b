"""Two numbers that suit a merged scene, chosen by renders.

How opaque and how large merged Gaussians must be to look like their members depends on how these overlap and on what is
behind them, and differs between scenes. So it is tried, in windows of several sizes of the picture
(:mod:`~pointsplat_ns.looking.windows`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.windows import WindowRenders
from pointsplat_ns.views import Views

LOOKED_AT = 8
"""Number of views whose windows are compared. Of 6, 12 and 24, 12 are as good as 24, and 6 lose up to 0.2 dB."""

DEEPENINGS = (0.0, 0.15, 0.3)
SPREADS = (-0.1, 0.0, 0.05)
"""Values of :class:`Finish` that are tried first."""


@dataclass(frozen=True)
class Finish:
    """How members become one."""

    deepening: float = 0.15
    """The optical depth of a merged Gaussian is multiplied by its number of members to this power. Merging keeps the
    mass but spreads it over a larger area, so that more of the background shows through."""
    spread: float = 0.0
    """Added to the log-scales of merged Gaussians."""
    psnr: float | None = None
    """Mean PSNR in windows of all sizes against the dense scene's renders, dB; None if nothing was rendered."""
    before: float | None = None
    """The same without any deepening or spread, dB."""

    @property
    def note(self) -> str:
        """One line of text: what was chosen, and what it gains."""
        numbers = f"optical depth x members^{self.deepening:.2f}, sizes x {math.exp(self.spread):.3f}"
        if self.psnr is None or self.before is None:
            return f"merged: {numbers}, by default"
        return f"merged: {numbers}, chosen by renders: {self.before:.2f} -> {self.psnr:.2f} dB"


class Reference(WindowRenders):
    """Windows of a dense scene's renders.

    Args:
        dense: N Gaussians.
        views: views of it.
    """

    def __init__(self, dense: Gaussians, views: Views):
        super().__init__(dense, views.spread(LOOKED_AT))

    def best(self, make: Callable[[Finish], Gaussians]) -> Finish:
        """The best finish of those tried: first the deepening, then the spread, each at the top of the parabola through
        three trials.

        Args:
            make: from a finish to a scene.
        """
        tried: dict[tuple[float, float], float] = {}

        def attempt(deepening: float, spread: float) -> float:
            if (deepening, spread) not in tried:
                tried[deepening, spread] = self.psnr(make(Finish(deepening, spread)))
            return tried[deepening, spread]

        before = attempt(0.0, 0.0)
        deepening = top_of_parabola(DEEPENINGS, [attempt(value, 0.0) for value in DEEPENINGS], beyond=0.15)
        # Beyond what was tried, the parabola is a guess: the nearest that was tried is gone on with as well.
        for value in dict.fromkeys((deepening, min(max(deepening, DEEPENINGS[0]), DEEPENINGS[-1]))):
            attempt(value, top_of_parabola(SPREADS, [attempt(value, spread) for spread in SPREADS], beyond=0.05))
        found = max(tried, key=lambda key: tried[key])
        return Finish(*found, psnr=tried[found], before=before)


def top_of_parabola(at: tuple[float, float, float], values: list[float], beyond: float) -> float:
    """Where the parabola through three points is highest, at most ``beyond`` outside of them. If it has no top, as far
    out if the values only rise that way, else the best of the three.

    Example:
        >>> round(top_of_parabola((0.0, 1.0, 3.0), [-4.0, -1.0, -1.0], beyond=0.0), 6)
        2.0
    """
    (a, b, c), (p, q, r) = at, values
    left, right = (q - p) / (b - a), (r - q) / (c - b)
    bend = (right - left) / (c - a)
    if bend >= 0 and left * right > 0:
        return c + beyond if right > 0 else a - beyond
    if bend >= 0 or bend != bend:
        return at[max(range(3), key=lambda index: values[index])]
    top = 0.5 * (a + b) - 0.5 * left / bend
    return min(max(top, a - beyond), c + beyond)
