"""Settings: measured ways of making a scene smaller."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

from pointsplat_ns.compression.repair import Effort
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.pruning import method_named, ply_bytes
from pointsplat_ns.tradeoff.points import Point

Repair = Literal["none", "refiner", "quick", "thorough", "photos"]
"""Kinds of repair: none; the refiner alone; the repair of ``compact`` of an effort; the effort ``quick``, and then a
training on the photos of a run."""

REPAIRS: tuple[Repair, ...] = get_args(Repair)

EFFORTS: dict[Repair, Effort] = {"refiner": "instant", "quick": "quick", "thorough": "thorough", "photos": "quick"}
"""The effort of ``compact`` for each repair."""


def repairs_of(effort: Effort) -> tuple[Repair, Repair]:
    """No repair, and the repair of an effort of ``compact``."""
    return "none", next(repair for repair, known in EFFORTS.items() if known == effort)


def check_repairs(repairs: tuple[str, ...]) -> tuple[Repair, ...]:
    """Repairs, each once, in the order of :data:`REPAIRS`. Raises PointSplatError if there is none, or one is
    unknown."""
    unknown = [repair for repair in repairs if repair not in REPAIRS]
    if unknown or not repairs:
        raise PointSplatError(f"repairs are {', '.join(repairs) or 'empty'}; expected some of {', '.join(REPAIRS)}")
    return tuple(repair for repair in REPAIRS if repair in repairs)


DENSE = "dense"
"""Key and method of the dense scene."""


@dataclass(frozen=True)
class Setting:
    """A way of making a scene smaller."""

    count: int
    """Number of Gaussians kept."""
    sh_degree: int
    repair: Repair = "none"
    by: str = "merge"

    @property
    def bytes(self) -> int:
        """Size of the file."""
        return ply_bytes(self.count, self.sh_degree)


def whole_of(dense: Gaussians, by: str) -> Setting:
    """The setting of a method that keeps all Gaussians and SH bands of a scene."""
    return Setting(len(dense), dense.sh_degree, by=by)


def setting_of(point: Point) -> Setting:
    """The setting of a point. Raises PointSplatError if its repair or method is unknown."""
    [repair] = check_repairs((point.repair,))
    by = point.by if point.by == DENSE else method_named(point.by).name
    return Setting(point.gaussians, point.sh_degree, repair, by)
