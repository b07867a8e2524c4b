"""Means of cells over the scenes of a group, with the scene of the largest loss."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

from lab.tables.cells import TABLE_FILES, About, Cell, CellJournal
from lab.tables.ways import PROTOCOL, WAYS
from pointsplat_ns.errors import SceneError
from pointsplat_ns.tradeoff.machine import is_busy
from pointsplat_ns.tradeoff.points import ImageMetrics, Point


@dataclass(frozen=True, eq=False)
class SceneCells:
    """All cells of a scene."""

    about: About
    cells: dict[tuple[str, float], Cell]
    """Cells by way and share."""

    def loss(self, point: Point) -> float | None:
        """Loss of PSNR against photos from the dense scene to a point, dB; None where it is not known."""
        dense = self.cells.get((WAYS.dense.name, 1.0))
        if point.against_photos is None or dense is None or dense.point.against_photos is None:
            return None
        return dense.point.against_photos.psnr - point.against_photos.psnr


@dataclass(frozen=True)
class Mean:
    """A row of a table: means over the scenes of the table, or over those that have the row's cell."""

    photos: ImageMetrics | None
    """None unless all scenes have held-out photos."""
    renders: ImageMetrics
    gaussians: float
    megabytes: float
    fps: float | None
    """Frames a second; None if other programs kept the machine busy during the timing."""
    scenes: int
    """Number of scenes in the mean."""
    comparable: bool
    """Whether these are the scenes of the table. If not, the row does not compare with others."""
    worst: str
    """Name of the scene with the largest loss."""
    worst_psnr: float
    """Its PSNR, dB: against photos, or against the dense scene's renders where there are no photos."""
    worst_loss: float | None
    """Its loss of PSNR against photos, dB, compared to the dense scene; None where it is not known."""


@dataclass(frozen=True, eq=False)
class Group:
    """Scenes with common means."""

    name: str
    scenes: tuple[SceneCells, ...]

    @property
    def dataset(self) -> str:
        """The dataset of the paper that has all scenes; empty if there is none."""
        datasets = {scene.about.dataset for scene in self.scenes}
        return datasets.pop() if len(datasets) == 1 and datasets <= {*PROTOCOL.datasets} else ""

    @property
    def comparable_dataset(self) -> str:
        """The dataset whose published figures compare with the group's: all scenes are of it, and were measured by the
        paper's protocol; empty if there is none."""
        return "" if any(scene.about.differs for scene in self.scenes) else self.dataset

    @property
    def has_photos(self) -> bool:
        """Whether some cells were compared with photos."""
        return any(cell.point.against_photos is not None for scene in self.scenes for cell in scene.cells.values())

    def shared(self, cells: Iterable[tuple[str, float]]) -> frozenset[str]:
        """Names of the scenes over which a table of these cells (way, share) takes its means: the set of scenes that
        most cells have; of several such sets, the largest. Means over different scenes do not compare."""
        found = Counter(
            frozenset(scene.about.name for scene in self.scenes if cell in scene.cells) for cell in dict.fromkeys(cells)
        )
        del found[frozenset()]
        return max(found, key=lambda names: (found[names], len(names), sorted(names)), default=frozenset())

    def mean(self, way: str, share: float, over: frozenset[str]) -> Mean | None:
        """The mean of a cell over the scenes of a table (:meth:`shared`). If one of these lacks the cell, the mean is
        over all scenes that have it, and not comparable; None if no scene has it."""
        found = [(scene, scene.cells[way, share].point) for scene in self.scenes if (way, share) in scene.cells]
        if not found:
            return None
        comparable = over <= {scene.about.name for scene, _ in found}
        if comparable:
            found = [(scene, point) for scene, point in found if scene.about.name in over]
        points = [point for _, point in found]
        photos = [point.against_photos for point in points if point.against_photos is not None]
        worst, point = max(found, key=lambda pair: _badness(*pair))
        return Mean(
            photos=_mean(photos) if len(photos) == len(points) else None,
            renders=_mean([point.against_dense for point in points]),
            gaussians=fmean(point.gaussians for point in points),
            megabytes=fmean(point.bytes / 1e6 for point in points),
            fps=None if any(map(_disturbed, points)) else fmean(1000 / point.frame_ms for point in points),
            scenes=len(points),
            comparable=comparable,
            worst=worst.about.name,
            worst_psnr=(point.against_photos or point.against_dense).psnr,
            worst_loss=worst.loss(point),
        )


def _disturbed(point: Point) -> bool:
    """Whether the time of a frame is not usable."""
    return not 0 < point.frame_ms < math.inf or (point.others_cores is not None and is_busy(point.others_cores))


def _badness(scene: SceneCells, point: Point) -> tuple[float, float]:
    """Sort key that rises with the loss, or else with falling PSNR."""
    loss, quality = scene.loss(point), point.against_photos or point.against_dense
    return -quality.psnr if loss is None else loss, -quality.psnr


def read_groups(folder: Path) -> list[Group]:
    """All scenes below a folder of tables, in groups; the paper's datasets first, the others by name. Raises SceneError
    if a journal cannot be read, or there is none."""
    scenes: dict[str, list[SceneCells]] = {}
    for path in sorted(folder.glob(f"*/{TABLE_FILES.cells}")):
        journal = CellJournal(folder, path.parent.name)
        if journal.about is None or journal.about.name != path.parent.name:
            raise SceneError(f"{path}: not the cells of {path.parent.name}; put its folder's name back, or remove it")
        scenes.setdefault(journal.about.group, []).append(SceneCells(journal.about, journal.cells))
    if not scenes:
        raise SceneError(f"{folder}: no scene with cells in it; nothing has been measured yet")
    groups = [Group(name, tuple(members)) for name, members in sorted(scenes.items())]
    return sorted(
        groups, key=lambda group: PROTOCOL.datasets.index(group.dataset) if group.dataset else len(PROTOCOL.datasets)
    )


def _mean(values: Sequence[ImageMetrics]) -> ImageMetrics:
    lpips = [value.lpips for value in values if value.lpips is not None]
    return ImageMetrics(
        fmean(value.psnr for value in values),
        fmean(value.ssim for value in values),
        fmean(lpips) if len(lpips) == len(values) else None,
    )
