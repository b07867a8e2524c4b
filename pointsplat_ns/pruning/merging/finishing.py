"""How a scene is finished: two numbers that suit all of its merged Gaussians, chosen by renders.

How opaque and how large a merged Gaussian must be to look like its members depends on how these overlap and on what is
behind them, and differs between scenes. Both numbers are chosen by the PSNR against the dense scene in windows of
several sizes of the picture (:mod:`~pointsplat_ns.looking.windows`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from pointsplat_ns.pruning.merging.settings import DEFAULTS, MergeSettings


@dataclass(frozen=True)
class Finish:
    """The two numbers of a scene."""

    depth_exponent: float = DEFAULTS.default_depth_exponent
    """The optical depth of a merged Gaussian is multiplied by its number of members to this power. Merging keeps the
    mass but spreads it over a larger area, so that more of the background shows through."""
    size_change: float = 0.0
    """Added to the log-scales of merged Gaussians."""
    psnr: float | None = None
    """Mean PSNR in windows of all sizes against the dense scene's renders, dB; None if nothing was rendered."""
    psnr_before: float | None = None
    """The same with a depth exponent and a size change of 0, dB."""

    @property
    def note(self) -> str:
        """One line of text: the numbers, and their gain."""
        numbers = f"optical depth x members^{self.depth_exponent:.2f}, sizes x {math.exp(self.size_change):.3f}"
        if self.psnr is None or self.psnr_before is None:
            return f"merged: {numbers}, by default"
        return f"merged: {numbers}, chosen by renders: {self.psnr_before:.2f} -> {self.psnr:.2f} dB"


def best_finish(psnr_of: Callable[[Finish], float], settings: MergeSettings = DEFAULTS) -> Finish:
    """The best finish of those tried: first the depth exponent, then the size, each at the top of the parabola through
    three trials.

    Args:
        psnr_of: PSNR of the scene with a finish, dB.
        settings: the trials.
    """
    tried: dict[tuple[float, float], float] = {}

    def attempt(exponent: float, size_change: float) -> float:
        if (exponent, size_change) not in tried:
            tried[exponent, size_change] = psnr_of(Finish(exponent, size_change))
        return tried[exponent, size_change]

    exponents, sizes = settings.depth_exponents, settings.size_changes
    before = attempt(0.0, 0.0)
    top = top_of_parabola(exponents, [attempt(value, 0.0) for value in exponents], settings.depth_exponent_margin)
    # Outside of the trials the parabola is a guess, so sizes are tried with the nearest trial as well.
    for exponent in dict.fromkeys((top, min(max(top, exponents[0]), exponents[-1]))):
        psnrs = [attempt(exponent, size_change) for size_change in sizes]
        attempt(exponent, top_of_parabola(sizes, psnrs, settings.size_change_margin))
    found = max(tried, key=lambda key: tried[key])
    return Finish(*found, psnr=tried[found], psnr_before=before)


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
