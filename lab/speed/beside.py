"""Whole `prune` commands beside splat-transform's: CPU seconds and memory at several budgets, and
their ratios.

    OMP_NUM_THREADS=1 python -m lab.speed.beside scenes/rock.ply --splat-transform
    node_modules/.bin/splat-transform \\
        --json docs/record/speed.json --resume
    python -m lab.speed.beside --write docs/record/speed.json

The second writes ``docs/record/speed.md``. Each process counts with its start, reading and writing.
Both programs take turns, so that a busy machine slows both alike.
"""

from __future__ import annotations

import compileall
from pathlib import Path
from typing import Annotated

import tyro

import pointsplat_ns
from lab.common.printing import markdown, start
from lab.common.results import Results, Row, grouped, write_page
from lab.common.ways import count_of, programs_of
from pointsplat_ns.scene.ply import PlyRows

OURS = "prune"

PAGE = """# Time beside splat-transform

`lab/speed/beside.py` measures these figures, and writes this page from [speed.json](speed.json).

- A cell has CPU seconds of `pointsplat prune`/of splat-transform `--decimate`, and their ratio. They are of whole
  processes on one thread. The machine was busy: compare ratios.
- MB: largest memory of both processes at the smallest budget that was measured. Torch's libraries take 540 MB of ours.
- Importing torch and the package takes 2.5 to 3 of our seconds.
- headquarter_garden_843k is the third level of [headquarter_garden](../benchmarks.md#scenes), by its publisher.
"""


def rows_of(source: Path, keeps: tuple[float, ...], splat_transform: str) -> list[Row]:
    """What both programs take for a scene, a row for each budget and program."""
    scene = PlyRows.open(source)
    about = {"scene": source.stem, "gaussians": scene.count, "sh_degree": scene.sh_degree}
    ours, theirs, *_ = programs_of((OURS,), (splat_transform,))
    rows = []
    for keep in keeps:
        for name, program in ((OURS, ours), (theirs.label, theirs)):
            _, usage = program.reduce(source, count_of(keep, scene.count))
            rows.append(about | {"keep": keep, "method": name, **vars(usage)})
    return rows


def page(rows: list[Row]) -> str:
    """The page of all scenes, the largest first."""
    keeps = sorted({row["keep"] for row in rows}, reverse=True)
    lines = []
    scenes = grouped(rows, lambda row: (row["scene"], row["gaussians"], row["sh_degree"]))
    for (scene, count, degree), same in sorted(scenes.items(), key=lambda item: -item[0][1]):
        pairs = {keep: [row for row in same if row["keep"] == keep] for keep in keeps}
        memory = "/".join(
            f"{row['peak_bytes'] / 1e6:,.0f}" for row in pairs[min(row["keep"] for row in same)]
        )
        lines.append([f"{scene}, {count:,}, SH {degree}", *map(_cell, pairs.values()), memory])
    heads = ("scene, Gaussians", *(f"{keep:.0%}" for keep in keeps), "MB")
    return f"{PAGE}\n{markdown(heads, lines)}\n"


def _cell(pair: list[Row]) -> str:
    """CPU seconds of both and their ratio; empty if they were not measured."""
    if not pair:
        return ""
    ours, theirs = (
        next(row["cpu_seconds"] for row in pair if (row["method"] == OURS) is own)
        for own in (True, False)
    )
    return f"{ours:.1f}/{theirs:.1f}={ours / theirs:.2f}"


def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    keep: tuple[float, ...] = (0.5, 0.3, 0.1, 0.03),
    splat_transform: str = "splat-transform",
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    write: Path | None = None,
) -> None:
    """Measure scenes, or write the page of what was measured.

    Args:
        scenes: PLYs.
        keep: shares of the Gaussians to keep.
        splat_transform: the program.
        json_path: write rows there, after each scene.
        resume: measure only the scenes that the file lacks.
        write: rows as JSON; speed.md is written beside.
    """
    if write is not None:
        write_page(write, page)
        return
    # as pip does at installation; a clone with PYTHONDONTWRITEBYTECODE compiles at every start
    compileall.compile_dir(Path(pointsplat_ns.__file__).parent, quiet=2)
    results = Results(json_path, {}, resume)
    for source in scenes:
        if not results.of(source.stem):
            results.put(source.stem, rows_of(source, keep, splat_transform))
    print(page(results.rows))


if __name__ == "__main__":
    start(main)
