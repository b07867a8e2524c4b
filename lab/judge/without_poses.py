"""What poses are worth: a trained run is made smaller without poses, with all of its training
poses, and with every third.

    python -m lab.judge.without_poses outputs/meeting/splatfacto-cpu/RUN --json without_poses.json
    --resume python -m lab.judge.without_poses RUN --keep 0.1 --ways prune --sets sampled all

The run's PLY, exported to a folder of its own, is merged (``prune``) and repaired (``compact``),
and compared with renders of the dense scene in the poses of held-out photos, at the photos' size.

``lab/judge/captures.py`` lists the captures, and how each is made ready and trained. Choose
constants on those for tuning.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import pandas as pd
import tyro

import pointsplat_ns as ps
from lab.common.printing import console, number, percent, start, table
from lab.common.results import Results, Row
from lab.common.ways import WAYS, Way, count_of
from lab.judge.scenes import (
    LEAST_WIDTH,
    DenseViews,
    JudgedScene,
    check,
    check_options,
    known_rows,
    load,
)
from pointsplat_ns.errors import SceneError
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.views import Views
from pointsplat_ns.system.progress import tracked

ViewSet = Literal["sampled", "all", "third"]
"""No poses; all training poses; every third of them."""

SETS: tuple[ViewSet, ...] = ("sampled", "all", "third")

DB = number(2)

Task = tuple[float, str, ViewSet]
"""A share to keep, a way, and a set of views."""


def chosen(name: ViewSet, poses: Views) -> Views | None:
    """The views of a set, of a run's training poses; None for sampled ones."""
    return None if name == "sampled" else poses if name == "all" else poses[::3]


def task_of(row: Row) -> Task:
    """The task that a row is of."""
    return row["keep"], row["method"], row["views"]


def rows_of(scene: JudgedScene, path: Path, tasks: list[Task]) -> Iterator[Row]:
    """One row for each task."""
    poses = dataset_views(path, "train")
    judge = DenseViews(scene.dense, scene.looks[0].views)
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / f"{scene.name}.ply"
        write_ply(scene.dense, ply)
        for keep, method, name in tasks:
            begin = time.process_time()
            small = _made(ply, count_of(keep, len(scene.dense)), method, chosen(name, poses))
            yield {
                **{
                    "scene": scene.name,
                    "digest": scene.digest,
                    "gaussians": len(scene.dense),
                    "count": len(small),
                },
                **{"keep": keep, "method": method, "views": name, "poses": len(poses)},
                **{"cpu_seconds": time.process_time() - begin, "psnr": judge.psnr(small)},
            }


def _made(ply: Path, count: int, way: str, views: Views | None) -> Gaussians:
    if way == "prune":
        return ps.prune(ply, count, views=views)
    return ps.compact(
        ply, count, effort="thorough" if way == "thorough" else "quick", views=views
    ).scene


def show(rows: list[Row]) -> None:
    """Print a table for each share, with the mean and the worst over scenes."""
    found = pd.DataFrame(rows)
    found["way"] = found["method"] + ", " + found["views"]
    values = found.pivot(index=["keep", "scene"], columns="way", values="psnr")
    order = [
        way
        for way in (f"{way}, {views}" for way, views in product(WAYS, SETS))
        if way in values.columns
    ]
    for keep, same in values[order].groupby("keep"):
        of_all = same.dropna()
        lines = [
            (scene, *map(DB, line))
            for (_, scene), line in zip(same.index, same.to_numpy(), strict=True)
        ]
        lines += [("mean", *map(DB, of_all.mean())), ("worst", *map(DB, of_all.min()))]
        console().print(
            table(f"{percent(keep)}: PSNR at the photos' size, dB", ("scene", *order), lines)
        )


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    keep: tuple[float, ...] = (0.1, 0.3),
    ways: tuple[Way, ...] = ("prune", "compact"),
    sets: tuple[ViewSet, ...] = SETS,
    views: int = 12,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    again: tuple[ViewSet, ...] = (),
) -> None:
    """Print what is lost without poses, with all training poses, and with every third.

    Args:
        runs: trained Splatfacto runs with held-out photos.
        keep: shares of the Gaussians to keep.
        ways: how scenes are made smaller: prune, compact, thorough.
        sets: views that are given: sampled (none), all training poses, every third of them.
        views: at most so many held-out poses of each run, evenly spread.
        json_path: write all rows there, after each.
        resume: take up the rows of that file. What it lacks is measured.
        again: sets of views that are measured though the file has them.
    """
    check_options(runs, keep, views, (LEAST_WIDTH,))
    if others := [path for path in runs if path.suffix == ".ply"]:
        raise SceneError(f"{others[0]}: a PLY; expected a run, whose dataset has the poses")
    names = check(runs)
    results = Results(json_path, {"views": views}, resume)
    for name, path in zip(names, runs, strict=True):
        scene = load(path, (), views)
        rows = {task_of(row): row for row in known_rows(results, scene)}
        tasks = [
            task for task in product(keep, ways, sets) if task not in rows or task[-1] in again
        ]
        print(
            f"{name}: {len(scene.dense):,} Gaussians, {len(scene.looks[0].views)} held-out poses",
            flush=True,
        )
        for row in tracked(rows_of(scene, path, tasks), name, len(tasks)):
            rows[task_of(row)] = row
            results.put(name, [*rows.values()])
    show([row for name in names for row in results.of(name)])


if __name__ == "__main__":
    start(main)
