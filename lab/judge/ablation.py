"""What each setting of merging is worth: scenes are merged with the defaults, and with variants that turn rules off.

    python -m lab.judge.ablation scenes/bouquet.ply RUN --json ablation.json --resume
    python -m lab.judge.ablation scenes/bouquet.ply --variants no_regrouping neighbours_8 --keep 0.1
    python -m lab.judge.ablation --write ablation.json               # docs/record/ablation.md, from one file or several

A PLY is looked at along the camera path of its name in ``lab/judge/paths``, a Splatfacto run from the poses of its
held-out photos. A run is merged twice: without poses, and with those of its training photos. ``lab/judge/variants.py``
has the variants. Choose constants on scenes for tuning (``python -m lab.judge.judge --list``).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import tyro

from lab.common.printing import console, start, table
from lab.common.results import Results, Row
from lab.common.scenes import room
from lab.common.ways import count_of
from lab.judge import ablation_record as record
from lab.judge.judge import LEAST_WIDTH, known_rows
from lab.judge.scenes import PHOTOS, JudgedScene, check, covered_psnr, load
from lab.judge.variants import BASELINE, applied, changes_of, names
from lab.judge.variants import check as check_variants
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.pruning.merging import merge
from pointsplat_ns.rasterizer import render, render_with_alpha
from pointsplat_ns.system.progress import progress_bar
from pointsplat_ns.views import Views

Task = tuple[int | str, float, str]
"""``at`` of a row (where the result is looked at, and whether poses are given), the share to keep, the variant."""


class Judge:
    """Compares smaller scenes with renders of the dense one, which are made once.

    Args:
        scene: with one look.

    Raises:
        SystemExit: if no view shows the scene.
    """

    def __init__(self, scene: JudgedScene):
        self.views = []
        for view in scene.looks[0].views:
            image, alpha = render_with_alpha(scene.dense, view)
            if covered := float(alpha.double().mean()):
                self.views.append((view, image, covered))
        if not self.views:
            raise SystemExit(f"{scene.name}: no view shows the scene; expected at least one")

    def psnr(self, small: Gaussians) -> float:
        """Mean over views of :func:`~lab.judge.scenes.covered_psnr`, dB."""
        return fmean(covered_psnr(render(small, view), image, covered) for view, image, covered in self.views)


def tasks_of(scene: JudgedScene, known: list[Row], keeps: tuple[float, ...], variants: list[str]) -> list[Task]:
    """The tasks that have no row yet, or one of other changes."""
    [look] = scene.looks
    ats = (PHOTOS, record.POSES) if look.at == PHOTOS else (look.at,)
    there = {(row["at"], row["keep"], row["method"]) for row in record.current(known)}
    tasks = [(at, keep, name) for at in ats for keep in keeps for name in (BASELINE, *variants)]
    return [task for task in tasks if task not in there]


@cache
def warm_up() -> None:
    """Merge a small room once, so that the first row does not count the seconds of imports."""
    merge(room(3_000), 300)


def row_of(scene: JudgedScene, task: Task, judge: Judge, poses: Views | None, report: Callable[[float], None]) -> Row:
    """The row of one task.

    Args:
        scene: with one look.
        task: what to do.
        judge: of this scene.
        poses: views that merging is given, or None.
        report: called with the share done of merging.
    """
    at, keep, name = task
    begin = time.process_time()
    with applied(name) as settings:
        small = merge(scene.dense, count_of(keep, len(scene.dense)), report, poses, settings=settings).scene
    seconds = time.process_time() - begin
    row: Row = {"scene": scene.name, "digest": scene.digest, "gaussians": len(scene.dense), "at": at, "keep": keep}
    return row | {
        "method": name,
        "changes": changes_of(name),
        "covered_psnr": judge.psnr(small),
        "cpu_seconds": seconds,
    }


def measure(scene: JudgedScene, path: Path, tasks: list[Task], results: Results, stay: list[Row]) -> None:
    """Measure tasks and write the rows of the scene after each.

    Args:
        scene: with one look.
        path: where it was read from.
        tasks: what to measure.
        results: where rows go.
        stay: rows of the scene that are there and stay.
    """
    rows = {record.key(row): row for row in stay}
    poses = dataset_views(path, "train") if any(at == record.POSES for at, _, _ in tasks) else None
    warm_up()
    with progress_bar() as show:
        judge = Judge(scene)
        for done, task in enumerate(tasks):
            at = task[0]

            def report(share: float, done: int = done) -> None:
                show(f"{scene.name}: merged and compared", (done + 0.9 * share) / len(tasks))

            row = row_of(scene, task, judge, poses if at == record.POSES else None, report)
            rows[record.key(row)] = row
            results.put(scene.name, list(rows.values()))


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    keep: tuple[float, ...] = (0.1, 0.5),
    variants: tuple[str, ...] = (),
    views: int = 8,
    width: int = 960,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    write: tuple[Path, ...] = (),
    record_folder: Annotated[Path, tyro.conf.arg(name="record")] = record.FOLDER,
) -> None:
    """Print what each setting of merging is worth: the change in dB where a variant takes the place of the defaults.

    Args:
        scenes: PLY files that have a camera path of their name, and Splatfacto runs, judged in their held-out photos.
        keep: shares of the Gaussians to keep.
        variants: names of variants to measure; none means all.
        views: at most so many views of each scene, evenly spread.
        width: of the pictures of camera paths, pixels; the height is 9/16 of it.
        json_path: write all rows there, after each.
        resume: take up the rows of that file. What it lacks is measured.
        write: only write the record, from these files of one or several runs.
        record_folder: folder of the record.
    """
    if write:
        if scenes:
            raise SystemExit("scenes and --write; expected one of both")
        for target in record.write(write, record_folder):
            print(target)
        return
    if not scenes:
        raise SystemExit("no scene named; expected PLY files or runs, or --write")
    if not all(0 < share <= 1 for share in keep):
        raise SystemExit(f"--keep {' '.join(map(str, keep))}; expected shares above 0, at most 1")
    if views < 1 or width < LEAST_WIDTH:
        raise SystemExit(f"{views} views of width {width}; expected at least 1, and {LEAST_WIDTH} pixels")
    check_variants(variants)
    chosen = list(variants) or names()
    results = Results(json_path, record.settings_of(views, width), resume)
    shown: list[Row] = []
    for name, path in zip(check(scenes), scenes, strict=True):
        scene = load(path, (width,), views)
        known = known_rows(results, scene)
        if tasks := tasks_of(scene, known, keep, chosen):
            measure(scene, path, tasks, results, known)
        shown += [row for row in results.of(name) if row["keep"] in keep]
    heads = ("variant", *(f"{100 * share:g} %, dB" for share in keep), "CPU")
    found = record.summaries(shown)
    lines = [(each.name, *map(each.cell, keep), f"{each.cpu_ratio:.2f}") for each in found]
    console().print(table("change by each variant, mean (smallest to largest)", heads, lines))


if __name__ == "__main__":
    start(main)
