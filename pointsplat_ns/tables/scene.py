"""A scene of the tables: what it is called, and what is read of it when a cell has to be measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.tradeoff.judging import LookedAt


@dataclass(frozen=True, eq=False)
class Opened:
    """A scene that has been read."""

    dense: Gaussians
    held_out: LookedAt
    """What scenes are judged in: held-out photos, or views alone where there are none."""
    training: LookedAt
    """What fine-tuning sees: training photos, or views alone."""
    new_views: Callable[[], ViewSource]
    """A fresh source of views: the one that the commands ``prune`` and ``compact`` have."""


@dataclass(frozen=True, eq=False)
class TableScene:
    """A scene that has not been read yet."""

    name: str
    path: Path
    """As the user named it."""
    sha256: str
    """Of the file with its Gaussians."""
    dataset: str
    """The dataset of the paper that it belongs to, "Replica" or "ScanNet++"; empty if it is another."""
    group: str | None
    """What means are taken over: scenes with the same name of a group. None for that of cells that are there, or the
    dataset's."""
    open: Callable[[TableOptions], Opened]


@dataclass(frozen=True)
class TableOptions:
    """How the cells are measured.

    Raises:
        PointSplatError: if one means nothing.
    """

    views: int = 10
    """Largest number of held-out views of a scene."""
    side: int = 640
    """Largest side of their images, and of those that are fine-tuned on and scored from, pixels."""
    scoring_views: int = 40
    """Largest number of training poses that LightGaussian and PUP-3DGS score from."""
    fine_tune: int = 300
    """Steps of fine-tuning."""

    def __post_init__(self) -> None:
        for name in ("views", "side", "scoring_views", "fine_tune"):
            if getattr(self, name) < 1:
                raise PointSplatError(f"{name.replace('_', ' ')}: {getattr(self, name)}; expected at least 1")

    @property
    def words(self) -> list[str]:
        """The options as words of the command, those that are not the defaults."""
        usual = vars(TableOptions())
        changed = {name: value for name, value in vars(self).items() if value != usual[name]}
        return [word for name, value in changed.items() for word in (f"--{name.replace('_', '-')}", str(value))]
