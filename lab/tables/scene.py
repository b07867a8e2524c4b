"""A scene of the tables: its name, and its data once a cell has to be measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pointsplat_ns.errors import PointSplatError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.tradeoff.judging import JudgedViews


@dataclass(frozen=True, eq=False)
class OpenedScene:
    """The data of a scene."""

    dense: Gaussians
    held_out: JudgedViews
    """Views to judge scenes in, with held-out photos where there are some."""
    training: JudgedViews
    """Views of fine-tuning, with training photos where there are some."""
    new_views: Callable[[], ViewSource]
    """Makes a new source of views, the same as for the commands ``prune`` and ``compact``."""
    differs: tuple[str, ...] = ()
    """Differences from the paper's protocol."""


@dataclass(frozen=True, eq=False)
class TableScene:
    """A scene that is opened when needed."""

    name: str
    path: Path
    """Path as the user gave it."""
    sha256: str
    """Hash of the file with its Gaussians."""
    dataset: str
    """Its dataset of the paper, "Replica" or "ScanNet++"; empty for others."""
    group: str | None
    """Name of its group, over which means are taken. None is the group of existing cells, or else the dataset."""
    open: Callable[[TableOptions], OpenedScene]


@dataclass(frozen=True)
class TableOptions:
    """Options of the measurement. Raises PointSplatError if an option is below 1."""

    views: int = 10
    """Largest number of held-out views of a scene."""
    side: int = 640
    """Longer side of the images for judging, fine-tuning and scoring, at most, pixels."""
    scoring_views: int = 40
    """Largest number of training poses for the scores of LightGaussian and PUP-3DGS."""
    fine_tune: int = 300
    """Steps of fine-tuning."""

    def __post_init__(self) -> None:
        for name in ("views", "side", "scoring_views", "fine_tune"):
            if getattr(self, name) < 1:
                raise PointSplatError(f"{name.replace('_', ' ')}: {getattr(self, name)}; expected at least 1")

    @property
    def training_views(self) -> int:
        """Largest number of views for fine-tuning and scoring. Their photos are in memory, at first in full size."""
        return max(60, self.scoring_views)

    @property
    def words(self) -> list[str]:
        """The options that are not defaults, as words of the command."""
        usual = vars(TableOptions())
        changed = {name: value for name, value in vars(self).items() if value != usual[name]}
        return [word for name, value in changed.items() for word in (f"--{name.replace('_', '-')}", str(value))]
