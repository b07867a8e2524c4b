"""Settings: measured ways of making a scene smaller, their names, and their commands."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from pointsplat_ns.compression.repair import Effort
from pointsplat_ns.compression.trained_refiner import SHIPPED
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.looking.sizes import size_text
from pointsplat_ns.pruning import method_named, ply_bytes
from pointsplat_ns.tradeoff.points import Point

Repair = Literal["none", "refiner", "quick", "thorough", "photos"]
"""Kinds of repair: none; the refiner alone; 48 steps; 400 steps; 48 steps, then a training on the photos of a run."""

REPAIRS: tuple[Repair, ...] = get_args(Repair)

EFFORTS: dict[Repair, Effort] = {"refiner": "instant", "quick": "quick", "thorough": "thorough", "photos": "quick"}
"""The effort of ``compact`` for each repair."""


def repairs_of(effort: Effort) -> tuple[Repair, Repair]:
    """No repair, and the repair of an effort of ``compact``."""
    return "none", next(repair for repair, known in EFFORTS.items() if known == effort)


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


def setting_of(point: Point) -> Setting:
    """The setting of a point other than the dense scene. Raises PointSplatError if its repair or method is unknown."""
    [repair] = check_repairs((point.repair,))
    return Setting(point.gaussians, point.sh_degree, repair, method_named(point.by).name)


@dataclass(frozen=True)
class Naming:
    """Makes the keys, labels and commands of settings.

    Example:
        >>> naming = Naming(Path("room.ply"), "room", 60_000, 3)
        >>> naming.key(Setting(6000, 3, "quick")), naming.label(Setting(6000, 0))
        ('10pct_sh3_quick', '10 %, SH degree 0')
        >>> print(naming.command(Setting(6000, 0)))
        pointsplat prune room.ply --keep 6000 --sh 0 -o room_10pct_sh0.ply
    """

    path: Path
    """Path of the scene in commands."""
    name: str
    count: int
    """Number of Gaussians in the dense scene."""
    sh_degree: int
    """SH degree of the dense scene."""
    poses: Path | None = None
    """Path of the file of cameras in commands."""
    resolution: tuple[int, int] | None = None
    """Width and height of pictures in pixels, if given."""

    def key(self, setting: Setting) -> str:
        """A short name that fits into names of files."""
        words = [f"{100 * setting.count / self.count:.4g}pct", f"sh{setting.sh_degree}"]
        words += [] if setting.repair == "none" else [setting.repair]
        words += [] if setting.by == "merge" else [setting.by]
        return "_".join(words)

    def label(self, setting: Setting) -> str:
        """A name for people."""
        words = [f"{100 * setting.count / self.count:.3g} %" + ("" if setting.by == "merge" else f" by {setting.by}")]
        words += [] if setting.sh_degree == self.sh_degree else [f"SH degree {setting.sh_degree}"]
        named = {"none": [], "refiner": ["refined"], "photos": ["trained on photos"]}
        words += named.get(setting.repair, [f"repaired ({setting.repair})"])
        return ", ".join(words)

    def command(self, setting: Setting) -> str:
        """The command that makes the scene. It has the count, because percentages are rounded."""
        program = "prune" if setting.repair == "none" else "compact"
        words = ["pointsplat", program, str(self.path), "--keep", str(setting.count)]
        if self.poses is not None:
            words += ["--poses", str(self.poses)]
        if self.resolution is not None:
            words += ["--resolution", size_text(self.resolution)]
        if program == "compact" or setting.by != "merge":
            words += ["--by", setting.by]
        if setting.sh_degree != self.sh_degree:
            words += ["--sh", str(setting.sh_degree)]
        if program == "compact":
            words += ["--refiner", SHIPPED] if setting.repair == "refiner" else []
            words += ["--effort", EFFORTS[setting.repair]]
            words += ["--photos"] if setting.repair == "photos" else []
        return shlex.join([*words, "-o", f"{self.name}_{self.key(setting)}.ply"])


def check_repairs(repairs: tuple[str, ...]) -> tuple[Repair, ...]:
    """Repairs, each once, in the order of :data:`REPAIRS`. Raises PointSplatError if there is none, or one is
    unknown."""
    unknown = [repair for repair in repairs if repair not in REPAIRS]
    if unknown or not repairs:
        raise PointSplatError(f"repairs are {', '.join(repairs) or 'empty'}; expected some of {', '.join(REPAIRS)}")
    return tuple(repair for repair in REPAIRS if repair in repairs)
