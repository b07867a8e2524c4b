"""Targets of a scene: its quality, the time of a frame, and the size of its file."""

from __future__ import annotations

import math
from dataclasses import dataclass

from pointsplat_ns.errors import BudgetError
from pointsplat_ns.io.files import bytes_text
from pointsplat_ns.metrics import MOST_PSNR
from pointsplat_ns.tradeoff.points import Point


@dataclass(frozen=True)
class Targets:
    """Targets of a scene. Raises BudgetError if there is no target, or one is not a positive number or above what
    differs from no error."""

    db: float | None = None
    """Least PSNR against the dense scene's renders, over the pixels that it covers, dB."""
    ms: float | None = None
    """Longest time of a frame, milliseconds."""
    mb: float | None = None
    """Largest file, in units of 10^6 bytes."""

    def __post_init__(self) -> None:
        given = {"--target-db": self.db, "--target-ms": self.ms, "--target-mb": self.mb}
        for name, value in given.items():
            if value is not None and not 0 < value < math.inf:
                raise BudgetError(f"{name} is {value:g}; expected a positive number")
        if self.db is not None and self.db > MOST_PSNR:
            raise BudgetError(
                f"--target-db is {self.db:g}; no smaller scene reaches it, expected at most {MOST_PSNR:g}"
            )
        if all(value is None for value in given.values()):
            raise BudgetError(f"no target is given; expected one of {', '.join(given)}")

    def missed(self, point: Point) -> list[str]:
        """Text on each target that a point misses; empty if it meets all."""
        words = []
        if self.db is not None and point.against_dense.psnr < self.db:
            words.append(f"{point.against_dense.psnr:.2f} dB where {self.db:g} are wanted")
        if self.ms is not None and point.frame_ms > self.ms:
            words.append(f"{point.frame_ms:.3g} ms a frame where {self.ms:g} are allowed")
        if self.mb is not None and point.bytes > 1e6 * self.mb:
            words.append(f"{bytes_text(point.bytes)} where {self.mb:g} are allowed")
        return words


def targets_of(
    db: float | None,
    ms: float | None,
    mb: float | None,
    keep: object = None,
    sh: str = "all",
    clean: bool = False,
    seconds: float | None = None,
    photos: bool = False,
) -> Targets | None:
    """Targets from options that may be missing; None if all are missing. Raises BudgetError if a target is invalid, or
    ``photos`` or an option that the search decides (keep, sh, clean, seconds) is given with a target."""
    if db is ms is mb is None:
        return None
    if photos:
        raise BudgetError("a search for targets renders the dense scene alone; expected targets or photos, not both")
    decided = {"keep": keep is not None, "sh": sh != "all", "clean": clean, "seconds": seconds is not None}
    names = [name for name, given in decided.items() if given]
    if names:
        raise BudgetError(
            f"{', '.join(names)} cannot be given with a target: how many Gaussians and SH bands are kept, and how they "
            "are repaired, is decided by what the scene needs"
        )
    return Targets(db, ms, mb)
