"""Large scenes: what `prune`, `compact` and splat-transform make of them, beside the publisher's
own levels.

    python -m lab.judge.large HeadquarterGarden/lod-meta.json --name headquarter_garden --json
    docs/record/large.json \\
        --splat-transform node_modules/.bin/splat-transform --resume
    python -m lab.judge.large taebak.ply --counts 425000 --json docs/record/large.json --resume
    python -m lab.judge.large --write docs/record/large.json

The last writes ``docs/record/large.md``. A streamed SOG is compared by its finest level, at the
counts of its others.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from statistics import fmean
from typing import Annotated

import tyro

from lab.common.printing import markdown, start
from lab.common.results import Results, Row, grouped, write_page
from lab.common.ways import PEER, WAYS, Reducer, Way, programs_of
from lab.judge.camera_paths import path_of, views_of
from lab.judge.scenes import DenseViews
from pointsplat_ns.scene.formats.sog_stream import coarser_levels
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.ply import write_ply
from pointsplat_ns.scene.reading import read_scene

PUBLISHED = "publisher's level"
"""Name of what a stream has."""

WIDTHS = (960, 1920)
"""Of pictures, pixels."""

FIRST = "prune"
"""The way whose seconds others are compared with."""

PAGE = f"""# Large scenes

`lab/judge/large.py` measured [large.json](large.json) and writes this page from it.

- PSNR in dB against renders of the whole scene, mean/worst over a camera path. Chance of sampled views: 0.2 dB.
- "x {FIRST}" is CPU time beside that of `{FIRST}`, of whole processes on one thread. GB: peak memory.
- {PEER}: `--decimate`. Its adaptive mode needs a GPU above 2.1 million.
"""


def rows_of(
    scene: Path, name: str, counts: tuple[int, ...], programs: list[Reducer], results: Results
) -> None:
    """Measure what the results lack of a scene, and put each row there at once."""
    whole = read_scene(scene)
    known = {(row["count"], row["way"]) for row in results.of(name)}
    judges = {width: DenseViews(whole, views_of(path_of(name), width)) for width in WIDTHS}

    def put(count: int, way: str, small: Gaussians, cost: dict[str, float | None]) -> None:
        row: Row = {
            "scene": name,
            "gaussians": len(whole),
            "count": count,
            "way": way,
            "kept": len(small),
            **cost,
        }
        for width, judge in judges.items():
            psnrs = judge.psnrs(small)
            row |= {f"mean_{width}": fmean(psnrs), f"worst_{width}": min(psnrs)}
        print(row, flush=True)
        results.put(name, [*results.of(name), row])

    levels = [] if scene.suffix == ".ply" else coarser_levels(scene, len(whole))
    for level in levels:
        if (len(level), PUBLISHED) not in known:
            put(len(level), PUBLISHED, level, {})
    counts = counts or tuple(len(level) for level in levels)
    del levels
    with tempfile.TemporaryDirectory(dir=scene.parent) as folder:
        ply = Path(folder) / "whole.ply"
        write_ply(whole, ply)
        for count in sorted(counts):
            for program in programs:
                if (count, program.label) not in known:
                    small, usage = program.reduce(ply, count)
                    put(count, program.label, small, vars(usage))


def page(rows: list[Row]) -> str:
    """The page of all scenes, the largest first."""
    parts = [PAGE]
    for (name, gaussians), same in sorted(
        grouped(rows, _scene).items(), key=lambda item: -item[0][1]
    ):
        lines = []
        for count, beside in sorted(grouped(same, lambda row: row["count"]).items(), reverse=True):
            first = next((row["cpu_seconds"] for row in beside if row["way"] == FIRST), None)
            for row in sorted(beside, key=_order):
                quality = [
                    f"{row[f'mean_{width}']:.1f}/{row[f'worst_{width}']:.1f}" for width in WIDTHS
                ]
                way = (
                    PEER
                    if row["way"].startswith(PEER)
                    else " ".join(WAYS.get(row["way"], (row["way"],)))
                )
                lines.append([f"{count:,}", way, *quality, *_cost(row, first)])
        heads = ("Gaussians", "way", *(f"{width} pixels" for width in WIDTHS), f"x {FIRST}", "GB")
        parts.append(f"## {name}, {gaussians:,} Gaussians\n\n{markdown(heads, lines)}\n")
    return "\n".join(parts)


def _scene(row: Row) -> tuple[str, int]:
    return row["scene"], row["gaussians"]


def _order(row: Row) -> tuple[bool, int, str]:
    """Sorts ways: the publisher's, the other program's, ours."""
    way = row["way"]
    return way != PUBLISHED, [*WAYS].index(way) if way in WAYS else -1, way


def _cost(row: Row, first: float | None) -> tuple[str, str]:
    """CPU time beside that of the first way, and memory; "-" where there is none."""
    if "cpu_seconds" not in row:
        return "-", "-"
    return f"{row['cpu_seconds'] / first:.2f}" if first else "-", f"{row['peak_bytes'] / 1e9:.1f}"


def main(
    scene: tyro.conf.Positional[Path | None] = None,
    name: str | None = None,
    counts: tuple[int, ...] = (),
    ways: tuple[Way, ...] = ("prune", "memory", "compact"),
    splat_transform: str | None = None,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    write: Path | None = None,
) -> None:
    """Measure a large scene, or write the page of what was measured.

    Args:
        scene: a PLY, or lod-meta.json of a streamed SOG.
        name: of a camera path in ``lab/judge/paths``; by default that of the file.
        counts: numbers of Gaussians to keep; by default those of the stream's levels.
        ways: of this package; memory is prune with a bound of its memory.
        splat_transform: the program.
        json_path: write all rows there, after each.
        resume: take up the rows of that file.
        write: rows as JSON; a page of the same name is written beside.
    """
    if write is not None:
        write_page(write, page)
        return
    if scene is None or (not counts and scene.suffix == ".ply"):
        raise SystemExit("expected a streamed SOG, or a PLY and --counts")
    results = Results(json_path, {}, resume)
    programs = programs_of(ways, () if splat_transform is None else (splat_transform,))[
        : len(ways) + 1
    ]
    rows_of(scene, name or scene.stem, counts, programs, results)
    print(page(results.rows))


if __name__ == "__main__":
    start(main)
