"""Reasons to reject a change to a scene."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Cause(Enum):
    """Causes for which a stage is rejected."""

    NO_CHANGE = "no change"
    NO_GAIN = "no gain"
    SMALL_GAIN = "small gain"
    WORSE_IN_MOST_VIEWS = "worse in most views"
    WORSE_IN_OTHER_SIZES = "worse in other sizes"
    WORSE_IN_OTHER_PHOTOS = "worse in other photos"
    NOT_FINITE = "not finite"
    NOT_COMPARED = "not compared"


@dataclass(frozen=True)
class Reason:
    """A cause to reject a stage, with its numbers."""

    cause: Cause
    count: int = 0
    """Number of Gaussians that are not finite."""
    total: int = 0
    """Number of all Gaussians."""
    decibels: float = 0.0
    """Minimum gain, or loss in other photos, dB."""
    error: str = ""
    """Error that prevented the comparison."""
