"""Why a change to a scene is left out."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Cause(Enum):
    """Kinds of reasons for which a stage is left out."""

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
    """Why a stage is left out, with its numbers."""

    cause: Cause
    count: int = 0
    """Number of Gaussians that are not finite."""
    total: int = 0
    """Number of Gaussians of which they are."""
    decibels: float = 0.0
    """Least gain that counts, or what other photos lose, dB."""
    error: str = ""
    """The error for which nothing was compared."""
