"""Cells of tables that are known in advance."""

import math
from pathlib import Path

from lab.tables.cells import BINS, About, Cell, CellJournal
from lab.tables.ways import WAYS, Way, cell_key
from pointsplat_ns.tradeoff.points import ImageMetrics, Point

IDENTITY = {"file": "abc", "machine": "a machine", "most views": 3}


def about(name: str, group: str = "scenes", dataset: str = "", differs: str = "") -> About:
    """A scene judged in three views."""
    return About(name, f"outputs/{name}", dataset, group, "held-out photos", "a machine", 3, 64, 48, differs)


def cell(name: str, way: Way, share: float, psnr: float, photos: float | None) -> Cell:
    """A cell of a scene of 1,000 Gaussians, of a PSNR against renders and, if there are any, photos."""
    shown = (way, share) in WAYS.figure_4
    middle = (*(0 for _ in range(9)), 7)
    point = Point(
        key=cell_key(name, way, share),
        label=way.label,
        command=f"python -m lab.tables outputs/{name} -o tables --only {cell_key(name, way, share)}",
        by=way.by or way.name,
        share=share,
        gaussians=round(1000 * share),
        sh_degree=3,
        repair="none",
        bytes=round(248_000 * share),
        against_dense=ImageMetrics(psnr, 0.9, 0.1),
        against_photos=None if photos is None else ImageMetrics(photos, 0.8, 0.2),
        frame_ms=10 * share,
        frame_ms_low=9 * share,
        frame_ms_high=12 * share,
        seconds=1.5,
    )
    opacities = (*middle, *(0 for _ in range(BINS.opacity - 10))) if shown else None
    volumes = (*middle, *(0 for _ in range(BINS.volume - 10))) if shown else None
    return Cell(way.name, point, "", 0, "0.1.0", "0123456789ab", opacities, volumes)


def write_scene(
    folder: Path,
    name: str,
    group: str = "scenes",
    dataset: str = "",
    worse: float = 0.0,
    photos: bool = True,
    without: tuple[str, ...] = (),
    differs: str = "",
) -> CellJournal:
    """Write the cells of a scene at 30 and 10 %, in all ways but those without."""
    journal = CellJournal(folder, name)
    for number, (way, share) in enumerate(WAYS.cells((0.3, 0.1))):
        dense = way == WAYS.dense
        lost = 0.0 if dense else 1 + worse + 0.1 * number
        against = 30.0 - lost if photos else None
        if way.name not in without:
            made = cell(name, way, share, math.inf if dense else 40 - lost, against)
            journal.add(made, about(name, group, dataset, differs), IDENTITY)
    return journal
