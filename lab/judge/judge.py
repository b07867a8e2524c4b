"""A judge that is not the defendant: what scenes lose when they are made smaller, in views that
were chosen by hand.

    python -m lab.judge.judge --list                            # which scenes are for tuning, which
    judge python -m lab.judge.judge --sheet sheets scenes/rock.ply    # what the views of a scene's
    path show python -m lab.judge.judge scenes/rock.ply RUN --splat-transform
    v3/node_modules/.bin/splat-transform \\
        --json judge.json --resume --again prune compact         # these two anew, all other rows as
        they are

A PLY is looked at along the camera path of its name in ``lab/judge/paths``, at several widths; a
Splatfacto run from the poses of its held-out photos. Every way runs as a process of its own that
reads the same PLY and writes one; its time and peak memory are those of that process. Smaller
scenes are not kept.
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import torch
import tyro
from rich.table import Table

from lab.common.compare import METRICS, lpips_or_none
from lab.common.printing import console, megabytes, number, percent, table
from lab.common.programs import ProgramFailed
from lab.common.results import Results, Row
from lab.common.scenes import JUDGED, TUNING, group_of
from lab.common.ways import WAYS, Reducer, Way, count_of, programs_of
from lab.judge.camera_paths import path_of, views_of
from lab.judge.record import Figures, at_order, section
from lab.judge.scenes import MEASURES, JudgedScene, check, check_options, known_rows, load, losses
from pointsplat_ns.errors import SceneError
from pointsplat_ns.metrics.lpips import Lpips
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.tools.comparison_plots import plot_views

Task = tuple[float, Reducer]
"""A share of the Gaussians to keep, and what makes the scene smaller."""


SHEET_WIDTH = 320
"""Width of a picture on a contact sheet, pixels."""

COSTS = ("seconds", "cpu_seconds", "peak_bytes")
"""What making a scene smaller took."""

HEADS = {
    "covered_psnr": ("covered PSNR", number(2)),
    **{
        f"{target}_{name}": (f"{prefix}{name.upper()}", number(2 if name == "psnr" else 3))
        for target, prefix in (("dense", ""), ("photo", "photo "))
        for name in METRICS
    },
    "count": ("splats", number(0)),
    "seconds": ("s", number(1)),
    "cpu_seconds": ("CPU s", number(1)),
    "peak_bytes": ("MB", megabytes),
}
"""Columns by what a row calls them: their heads, and how a value is written."""


def tasks_of(
    scene: JudgedScene,
    known: list[Row],
    keeps: tuple[float, ...],
    ways: list[Reducer],
    again: tuple[str, ...],
) -> list[Task]:
    """What is to be measured: ways to do again, and what does not have a row for each look."""
    there = {(row["keep"], row["method"], row["at"]) for row in known if not row["failed"]}
    return [
        (keep, way)
        for keep in keeps
        for way in ways
        if way.label in again
        or any((keep, way.label, look.at) not in there for look in scene.looks)
    ]


def rows_that_stay(
    scene: JudgedScene, known: list[Row], tasks: list[Task], again: tuple[str, ...]
) -> list[Row]:
    """The known rows that new ones do not replace. What is done again replaces rows of all widths,
    since they may be of an older program."""
    done = {(keep, way.label) for keep, way in tasks}
    at = {look.at for look in scene.looks}
    return [
        row
        for row in known
        if (row["keep"], row["method"]) not in done
        or not (row["failed"] or row["method"] in again or row["at"] in at)
    ]


def rows_of(scene: JudgedScene, path: Path, tasks: list[Task], lpips: Lpips | None) -> list[Row]:
    """One row for each task and look."""
    total = len(tasks)
    reduced = list(tracked(_reduced(scene, path, tasks), f"{scene.name}: made smaller", total))
    rows = [about for about, small in reduced if small is None]
    done = [(about, small) for about, small in reduced if small is not None]
    found = losses(scene, [small for _, small in done], lpips)
    for index, look, measures in tracked(
        found, f"{scene.name}: compared", len(done) * len(scene.looks)
    ):
        rows.append(done[index][0] | {"at": look.at, "views": len(look.views)} | measures)
    return rows


def _reduced(
    scene: JudgedScene, path: Path, tasks: list[Task]
) -> Iterator[tuple[Row, Gaussians | None]]:
    """What each task makes of a scene, and what it took; None, and why, where it failed."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "dense.ply"
        if path.suffix == ".ply":
            shutil.copyfile(path, source)
        else:
            write_ply(scene.dense, source)
        for keep, way in tasks:
            about: Row = {
                "scene": scene.name,
                "digest": scene.digest,
                "keep": keep,
                "method": way.label,
            }
            about |= {"gaussians": len(scene.dense), "failed": ""}
            try:
                small, usage = way.reduce(source, count_of(keep, len(scene.dense)))
            except (ProgramFailed, SceneError) as error:
                print(f"{scene.name}: {way.label} at {percent(keep)} failed: {error}", flush=True)
                nothing = dict.fromkeys(("count", *COSTS, *MEASURES))
                yield about | {"failed": str(error), "at": scene.looks[0].at} | nothing, None
                continue
            yield about | {"count": len(small)} | vars(usage), small


def ordered(rows: list[Row]) -> list[Row]:
    """Rows of a scene by width, then by budget, our own ways first."""
    ours = list(WAYS)

    def key(row: Row) -> Any:
        method = row["method"]
        return (
            at_order(row["at"]),
            -row["keep"],
            (ours.index(method) if method in ours else len(ours), method),
        )

    return sorted(rows, key=key)


def scene_table(rows: list[Row]) -> Table:
    """The rows of one scene; a dash for what cannot be had, no column for what none has."""
    columns = [name for name in HEADS if any(row.get(name) is not None for row in rows)]
    lines = [
        [
            row["at"],
            percent(row["keep"]),
            row["method"],
            *(HEADS[name][1](row.get(name)) for name in columns),
        ]
        for row in rows
    ]
    title = f"{rows[0]['scene']}: against the dense scene's renders; MB: peak memory; photos last"
    return table(
        title, ["at", "kept", "way", *(HEADS[column][0] for column in columns)], lines, left=["way"]
    )


def scene_list() -> Table:
    """Which scenes are for tuning and which judge, and which have a camera path."""
    others = sorted({path.stem for path in path_of("").parent.glob("*.json")} - {*TUNING, *JUDGED})
    names = (*TUNING, *JUDGED, *others)
    lines = [
        (n, group_of(n) or "other", path_of(n).name if path_of(n).is_file() else "-") for n in names
    ]
    heads = ("scene", "for", "camera path")
    return table(
        "scenes; those with photos are judged in the poses of held-out photos", heads, lines, heads
    )


def write_sheets(scenes: tuple[Path, ...], folder: Path) -> None:
    """Draw the views of each scene's path into a folder, one PNG a scene."""
    folder.mkdir(parents=True, exist_ok=True)
    for path in scenes:
        scene = read_scene(path)
        source = ViewProvider(scene, views_of(path_of(path.stem), SHEET_WIDTH))
        print(plot_views(scene, source, folder / f"{path.stem}.png"), flush=True)


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    keep: tuple[float, ...] = (0.5, 0.3, 0.1, 0.03),
    ways: tuple[Way, ...] = ("prune", "compact"),
    splat_transform: tuple[str, ...] = (),
    widths: tuple[int, ...] = (320, 960, 1920),
    views: int = 16,
    lpips: bool = True,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    again: tuple[str, ...] = (),
    sheet: Path | None = None,
    list_scenes: Annotated[bool, tyro.conf.arg(name="list")] = False,
) -> None:
    """Print tables of what scenes lose, in views that were chosen by hand.

    Args:
        scenes: PLY files that have a camera path of their name, and Splatfacto runs, judged in
            their held-out photos.
        keep: shares of the Gaussians to keep.
        ways: prune and compact as a user calls them; memory: prune in 2 GB; thorough: compact with
            that effort.
        splat_transform: programs, of any versions, each of whose modes is a way too.
        widths: of the pictures of camera paths, pixels; the height is 9/16 of it.
        views: at most so many views of each scene, evenly spread.
        lpips: whether to compute LPIPS, which is done up to 960 pixels wide.
        json_path: write all rows there, after each scene.
        resume: take up the rows of that file, also of ways that are not asked for now. What it
            lacks is measured.
        again: ways, as the tables call them, that are measured though the file has them.
        sheet: only draw what the views show: one picture a scene, into this folder.
        list_scenes: only print which scenes are for tuning, and which judge.
    """
    if list_scenes:
        console().print(scene_list())
        return
    if sheet is not None:
        write_sheets(scenes, sheet)
        return
    check_options(scenes, keep, views, widths)
    programs = programs_of(ways, splat_transform)
    labels = [program.label for program in programs]
    if unknown := {*again} - {*labels}:
        raise SystemExit(
            f"--again {', '.join(sorted(unknown))}; expected some of: {', '.join(labels)}"
        )
    if again and not resume:
        raise SystemExit("--again without --resume; expected the file whose other rows stay")
    names = check(scenes)
    network = lpips_or_none(lpips)
    results = Results(json_path, {"views": views, "lpips": network is not None}, resume)
    shown: list[Row] = []
    for name, path in zip(names, scenes, strict=True):
        scene = load(path, widths, views)
        known = known_rows(results, scene)
        if tasks := tasks_of(scene, known, keep, programs, again):
            print(
                f"{name}: {len(scene.dense):,} Gaussians, {len(scene.looks[0].views)} views",
                flush=True,
            )
            stay = rows_that_stay(scene, known, tasks, again)
            results.put(name, ordered(stay + rows_of(scene, path, tasks, network)))
        else:
            print(f"{name}: as {json_path} has it")
        at = {look.at for look in scene.looks}
        rows = [row for row in results.of(name) if row["keep"] in keep and row["at"] in at]
        console().print(scene_table(rows))
        shown += rows
    figures = Figures(shown)
    print("\n\n".join(section(figures, at) for at in figures.ats))


if __name__ == "__main__":
    tyro.cli(main)
