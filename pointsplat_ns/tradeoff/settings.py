"""Settings: the ways of making a scene smaller that are measured, their names, and their commands."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

from torch import Tensor

from pointsplat_ns.compression.repair import Effort
from pointsplat_ns.compression.trained_refiner import SHIPPED
from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.windows import size_text
from pointsplat_ns.pruning import method_named, ply_bytes
from pointsplat_ns.rasterizer import render
from pointsplat_ns.tradeoff.points import Point
from pointsplat_ns.views import View

Repair = Literal["none", "refiner", "quick", "thorough"]
"""Nothing; the refiner alone; 48 steps; 400 steps."""

REPAIRS: tuple[Repair, ...] = get_args(Repair)

EFFORTS: dict[Repair, Effort] = {"refiner": "instant", "quick": "quick", "thorough": "thorough"}
"""The effort of ``compact`` that each repair is."""


def repairs_of(effort: Effort) -> tuple[Repair, Repair]:
    """None, or the repair that is an effort of ``compact``."""
    return "none", next(repair for repair, known in EFFORTS.items() if known == effort)


Drawn = Literal["exact", "fast", "half"]
"""How frames are drawn: as they are; with ``quality="fast"``, that leaves out what is nearly transparent; or so and at
half the resolution, enlarged."""

DRAWN: tuple[Drawn, ...] = get_args(Drawn)

DENSE = "dense"
"""Key and method of the scene as it is."""


@dataclass(frozen=True)
class Setting:
    """A way of making a scene smaller."""

    count: int
    """Number of Gaussians kept."""
    sh_degree: int
    repair: Repair = "none"
    by: str = "merge"
    drawn: Drawn = "exact"

    @property
    def scene(self) -> Setting:
        """The setting of the same scene, drawn exactly."""
        return replace(self, drawn="exact")

    @property
    def bytes(self) -> int:
        """Size of the file."""
        return ply_bytes(self.count, self.sh_degree)


def setting_of(point: Point) -> Setting:
    """The setting that a point, other than the dense scene, was measured with.

    Raises:
        PointSplatError: if there is no such repair, method or way to draw.
    """
    repair, drawn = check_repairs((point.repair,))[0], check_drawn((point.drawn,))[0]
    return Setting(point.gaussians, point.sh_degree, repair, method_named(point.by).name, drawn)


def draw(scene: Gaussians, view: View, drawn: Drawn) -> Tensor:
    """The picture (H, W, 3) of a view."""
    return render(scene, view, "exact" if drawn == "exact" else "fast", 2 if drawn == "half" else 1)


_CALLS: dict[Drawn, str] = {
    "fast": 'ps.render(scene, views, quality="fast")',
    "half": 'ps.render(scene, views, quality="fast", reduced=2)',
}
"""How a user draws so."""


@dataclass(frozen=True)
class Naming:
    """What settings of a scene are called.

    Example:
        >>> naming = Naming(Path("room.ply"), "room", 60_000, 3)
        >>> naming.key(Setting(6000, 3, "quick")), naming.label(Setting(6000, 0))
        ('10pct_sh3_quick', '10 %, SH degree 0')
        >>> print(naming.command(Setting(6000, 0)))
        pointsplat prune room.ply --keep 6000 --sh 0 -o room_10pct_sh0.ply
    """

    path: Path
    """The scene, as commands name it."""
    name: str
    count: int
    """Number of Gaussians in it."""
    sh_degree: int
    """And their SH degree."""
    poses: Path | None = None
    """The file of cameras that the scene is looked at from, as commands name it."""
    resolution: tuple[int, int] | None = None
    """Width and height of pictures, pixels, if they were asked for."""

    def key(self, setting: Setting) -> str:
        """A short name that can be part of a file's name."""
        words = [f"{100 * setting.count / self.count:.4g}pct", f"sh{setting.sh_degree}"]
        words += [] if setting.repair == "none" else [setting.repair]
        words += [] if setting.by == "merge" else [setting.by]
        words += [] if setting.drawn == "exact" else [setting.drawn]
        return "_".join(words)

    def label(self, setting: Setting) -> str:
        """The same for people."""
        words = [f"{100 * setting.count / self.count:.3g} %" + ("" if setting.by == "merge" else f" by {setting.by}")]
        words += [] if setting.sh_degree == self.sh_degree else [f"SH degree {setting.sh_degree}"]
        repaired = "refined" if setting.repair == "refiner" else f"repaired ({setting.repair})"
        words += [] if setting.repair == "none" else [repaired]
        words += {"exact": [], "fast": ["drawn fast"], "half": ["drawn at half the size"]}[setting.drawn]
        return ", ".join(words)

    def command(self, setting: Setting) -> str:
        """The command that makes the scene, with a comment on how it is drawn if not exactly. Counts are exact, as
        percentages may be rounded."""
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
        command = shlex.join([*words, "-o", f"{self.name}_{self.key(setting.scene)}.ply"])
        return command if setting.drawn == "exact" else f"{command}  # drawn by {_CALLS[setting.drawn]}"


def check_repairs(repairs: tuple[str, ...]) -> tuple[Repair, ...]:
    """Repairs, each once, in the order of :data:`REPAIRS`.

    Raises:
        PointSplatError: if none is given, or one is unknown.
    """
    unknown = [repair for repair in repairs if repair not in REPAIRS]
    if unknown or not repairs:
        raise PointSplatError(f"repairs are {', '.join(repairs) or 'empty'}; expected some of {', '.join(REPAIRS)}")
    return tuple(repair for repair in REPAIRS if repair in repairs)


def check_drawn(drawn: tuple[str, ...]) -> tuple[Drawn, ...]:
    """Ways to draw, each once, in the order of :data:`DRAWN`.

    Raises:
        PointSplatError: if one is unknown.
    """
    unknown = [way for way in drawn if way not in DRAWN]
    if unknown:
        raise PointSplatError(f"frames drawn {', '.join(unknown)}; expected some of {', '.join(DRAWN)}")
    return tuple(way for way in DRAWN if way in drawn)
