"""What is lost when a scene is made smaller, by every method at hand, before any refinement.

    python benchmarks/compaction.py outputs/kitchen/splatfacto-cpu/TIME scene.ply --methods merge --json compaction.json
    python benchmarks/compaction.py RUN --sweep          # lambda from 0.1 to 0.9 of the scores "paper" and "authors"
    python benchmarks/compaction.py --speed              # 1M synthetic Gaussians: every score, and merging
    python benchmarks/compaction.py --scaling            # merging 100k to 10M synthetic Gaussians: time and memory

Renders are compared with the dense scene's own and, for runs, with held-out photos, at the size that the run was
trained at; a PLY is looked at from poses sampled in its free space. With Node and @playcanvas/splat-transform
(``npm install @playcanvas/splat-transform``) its modes are rows too, at the same counts in the same run. Every program
runs as a process of its own that reads the same PLY and writes one; its time and peak memory are those of that process.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import tyro
from compaction_tables import MERGE, PAIRS, Row, averages, lead_table, leads, table
from held_out import Scene, compare, load, lpips_or_none, name_of
from options import write_whole
from printing import console
from processes import COMPACT, count_of, pointsplat_compact, pointsplat_prune
from results import Results
from scaling import print_score_times, scaling_rows, scaling_table, slope_table, slopes
from splat_transform import peers_of

from pointsplat_ns.gaussians import MAX_SH_DEGREE, Gaussians
from pointsplat_ns.io import read_scene, write_ply
from pointsplat_ns.metrics import psnr
from pointsplat_ns.metrics.lpips import Lpips
from pointsplat_ns.pruning import METHODS, prune
from pointsplat_ns.system.programs import Usage
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.tables.splat_transform import NAME, Reducer

NEED_NO_VIEWS = tuple(name for name, method in METHODS.items() if not method.needs_views)
SWEEP = tuple(round(0.1 * i, 1) for i in range(1, 10))
SPEED = (1_000_000,)
SCALING = (100_000, 300_000, 1_000_000, 3_000_000, 10_000_000)


def rows_of(
    scene: Scene, keeps: tuple[float, ...], inside: tuple[str, ...], programs: list[Reducer], lpips: Lpips | None
) -> Iterator[Row]:
    """One row for each budget and way: methods called within this process, then programs."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "dense.ply"
        if programs:
            write_ply(scene.dense, source)
        for keep in keeps:
            count = count_of(keep, len(scene.dense))
            for method in inside:
                small, usage = _pruned(scene.dense, count, method)
                yield _row(scene, keep, method, small, usage, lpips)
            for program in programs:
                small, usage = program.reduce(source, count)
                yield _row(scene, keep, program.label, small, usage, lpips)


def sweep_rows(scene: Scene, keeps: tuple[float, ...], lpips: Lpips | None) -> Iterator[Row]:
    """The paper's Table 3: the weight of opacity against that of volume."""
    for keep in keeps:
        for method in ("paper", "authors"):
            for weight in SWEEP:
                small, usage = _pruned(scene.dense, count_of(keep, len(scene.dense)), method, weight)
                yield _row(scene, keep, f"{method} {weight}", small, usage, lpips)


def _pruned(dense: Gaussians, count: int, method: str, weight: float | None = None) -> tuple[Gaussians, Usage]:
    start, cpu_start = time.perf_counter(), time.process_time()
    small = prune(dense, count, method, opacity_weight=weight)
    return small, Usage(time.perf_counter() - start, time.process_time() - cpu_start, None)


def _row(scene: Scene, keep: float, method: str, small: Gaussians, usage: Usage, lpips: Lpips | None) -> Row:
    about = {"scene": scene.name, "keep": keep, "method": method, "gaussians": len(scene.dense), "count": len(small)}
    return about | vars(usage) | compare(scene, small, lpips)


def rows_that_stand(results: Results, name: str, path: Path) -> list[Row]:
    """The rows of a scene that are there, if it still has as many Gaussians."""
    rows = results.of(name)
    return rows if rows and len(read_scene(path)) == rows[0]["gaussians"] else []


def summaries(rows: list[Row]) -> dict[str, list[Row]]:
    """What the file tells beside the rows."""
    return {"averages": averages(rows), "leads": leads(rows)}


def measure_scaling(counts: tuple[int, ...], sh_degree: int, programs: list[Reducer], path: Path | None) -> None:
    """Print what making synthetic scenes smaller takes."""
    rows: list[Row] = []
    for row in scaling_rows(counts, sh_degree, programs):
        rows.append(row)
        took = row["failed"] or f"{row['seconds']:.1f} s, {row['peak_bytes'] / 1e6:,.0f} MB"
        print(f"{row['gaussians']:,} {row['method']}: {took}", flush=True)
        write_whole(path, {"rows": rows, "slopes": slopes(rows)})
    console().print(scaling_table(rows), slope_table(slopes(rows)))


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    keep: tuple[float, ...] = (0.5, 0.3, 0.1, 0.03),
    methods: tuple[str, ...] = NEED_NO_VIEWS,
    views: int = 8,
    compact: bool = False,
    splat_transform: tuple[str, ...] = (),
    in_process: bool = False,
    lpips: bool = True,
    sweep: bool = False,
    speed: bool = False,
    scaling: bool = False,
    gaussians: tuple[int, ...] = (),
    sh_degree: int = 3,
    sh: int = MAX_SH_DEGREE,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
) -> None:
    """Print tables of what every method loses.

    Args:
        scenes: Splatfacto runs, judged in their held-out views, and PLY files.
        keep: shares of the Gaussians to keep.
        methods: rows; "merge" alone gives the table that compares it with splat-transform.
        views: at most so many views of each scene.
        compact: ``pointsplat compact`` with its defaults, which repairs what it merged, is a row too.
        splat_transform: programs, of any versions, each of whose modes is a row; by default the one that
            ``npx --no-install splat-transform`` finds.
        in_process: call our methods within this process: faster, but the seconds leave out starting, reading and
            writing, and there is no peak memory.
        lpips: whether to compute LPIPS.
        sweep: the scores "paper" and "authors" over their lambda, in place of all methods.
        speed: only the times of all scores, and time and memory of merging, on synthetic Gaussians.
        scaling: only time and memory of merging to a tenth, on synthetic Gaussians of several numbers.
        gaussians: these numbers; by default 1 million for the speed, and 100,000 to 10 million for the scaling.
        sh_degree: of the synthetic Gaussians.
        sh: cut scenes to this SH degree first.
        json_path: write all rows there, after each scene.
        resume: take up the rows of that file: scenes that it has are not measured again.
    """
    peers, missing = ([], "") if sweep else peers_of(splat_transform)
    if speed or scaling:
        counts = gaussians or (SCALING if scaling else SPEED)
        for n in counts if speed else ():
            print_score_times(n, sh_degree)
        measure_scaling(counts, sh_degree, [pointsplat_prune("merge"), *peers], json_path)
        return
    names = [name_of(path) for path in scenes]
    if not scenes:
        raise SystemExit("no scene named; expected runs or PLY files, or --speed or --scaling")
    if len({*names}) < len(names):
        raise SystemExit(f"two scenes have one name: {', '.join(names)}; expected different ones")
    network = lpips_or_none(lpips)
    inside = methods if in_process else ()
    programs = [
        *([] if in_process else map(pointsplat_prune, methods)),
        *([pointsplat_compact()] if compact else []),
        *peers,
    ]
    ways = ["sweep"] if sweep else [*inside, *(program.label for program in programs)]
    settings = {"keep": keep, "methods": ways, "views": views, "in_process": in_process, "lpips": network is not None}
    settings |= {"sh": sh} if sh < MAX_SH_DEGREE else {}
    results = Results(json_path, settings, resume, summaries)
    shown: list[Row] = []
    for name, path in zip(names, scenes, strict=True):
        rows = rows_that_stand(results, name, path)
        if rows:
            print(f"{name}: as {json_path} has it")
        else:
            scene = load(path, views, sh)
            against = f", dense against photos {_dense_psnr(scene):.2f} dB" if scene.photos else ""
            print(f"{name}: {len(scene.dense):,} Gaussians, {len(scene.renders)} views{against}", flush=True)
            if sweep:
                found, total = sweep_rows(scene, keep, network), 2 * len(SWEEP)
            else:
                found, total = rows_of(scene, keep, inside, programs, network), len(ways)
            rows = list(tracked(found, name, len(keep) * total))
            results.put(name, rows)
        console().print(table(rows))
        shown += rows
    if len(scenes) > 1:
        console().print(table(averages(shown)))
    for method in (MERGE, COMPACT):
        for column in PAIRS:
            if (compared := lead_table(leads(shown, method), column, method)) is not None:
                console().print(compared)
    if missing:
        print(f"{NAME}: - ({missing})")


def _dense_psnr(scene: Scene) -> float:
    return fmean(float(psnr(a, b)) for a, b in zip(scene.renders, scene.photos or [], strict=True))


if __name__ == "__main__":
    tyro.cli(main)
