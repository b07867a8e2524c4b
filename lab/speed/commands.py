"""Time and memory of whole commands against the number of Gaussians: `prune`, `compact` and splat-transform.

    python -m lab.speed.commands --gaussians 100000 300000 1000000 --json commands.json
    python -m lab.speed.commands --gaussians 1000000 --keep 0.5 --sh-degree 0  # bytes a Gaussian
    python -m lab.speed.commands --ways compact --splat-transform v3/node_modules/.bin/splat-transform

Synthetic scenes are made smaller, by default to a tenth, from file to file, each in a process of its own: seconds, CPU
seconds and peak memory are those of that process, with starting it. The slope of log time over log Gaussians is 1 where
time is linear; "beyond the start" leaves out what a scene of 1,000 Gaussians takes. Bytes a Gaussian are the peak
memory beyond the size of the file and what a process holds that has only imported this package.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
from rich.table import Table

from lab.common.printing import console, megabytes, number, start, table
from lab.common.results import Row, grouped, write_json
from lab.common.scenes import KEEP, room
from lab.common.timing import slope
from lab.common.ways import WAYS, Way, count_of, programs_of
from lab.tables.making import Reducer
from pointsplat_ns.io import write_ply
from pointsplat_ns.pruning import ply_bytes
from pointsplat_ns.system.programs import ProgramFailed, run_measured

START = 1000
"""Gaussians of the scene that shows what starting a program costs."""

IMPORTS = "import os, tyro, pointsplat_ns.compacting, pointsplat_ns.pruning.merging; os._exit(0)"
"""What a process does that holds the libraries alone. Unloading torch would take more memory."""

HELD_BY_WRITING = 2.5
"""Memory that making and writing a scene takes, in sizes of its file: the tensors, one copy, the records."""


def rows_of(counts: tuple[int, ...], sh_degree: int, programs: list[Reducer], keep: float) -> Iterator[Row]:
    """What each program takes for each size of scene, the smallest first.

    A size that is expected to need more memory or disk than is free is left out; ``failed`` says so.
    """
    before: dict[str, Row] = {}
    for n in (START, *sorted(counts)):
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "dense.ply"
            size = ply_bytes(n, sh_degree)
            no_room = _more_than("disk", (1 + keep) * size, shutil.disk_usage(folder).free)
            no_room = no_room or _more_than("memory", HELD_BY_WRITING * size, psutil.virtual_memory().available)
            if not no_room:
                write_ply(room(n, sh_degree), source)
            for program in programs:
                row: Row = {"method": program.label, "gaussians": n, "sh_degree": sh_degree, "file_bytes": size}
                row |= {"count": None, "seconds": None, "cpu_seconds": None, "peak_bytes": None}
                expected = _expected_bytes(before.get(program.label), n)
                row["failed"] = no_room or _more_than("memory", expected, psutil.virtual_memory().available)
                if not row["failed"]:
                    try:
                        small, usage = program.reduce(source, count_of(keep, n))
                        row |= {"count": len(small), **vars(usage)}
                        before[program.label] = row
                    except ProgramFailed as error:
                        row["failed"] = str(error)
                yield row


def _expected_bytes(before: Row | None, n: int) -> float:
    """Peak memory in proportion to that of the size before; 0 where it is not known."""
    return 0.0 if before is None or before["gaussians"] == START else before["peak_bytes"] * n / before["gaussians"]


def _more_than(what: str, needed: float, free: float) -> str:
    return f"about {needed / 1e9:.3g} GB of {what} needed, {free / 1e9:.3g} GB free" if needed > free else ""


def slopes(rows: list[Row]) -> list[Row]:
    """For each program, the slope of its seconds and CPU seconds, as they are and beyond those of the start."""
    result = []
    for method, same in grouped(rows, lambda row: row["method"]).items():
        done = [row for row in same if row["seconds"] is not None]
        first = next((row for row in done if row["gaussians"] == START), None)
        sizes = [row for row in done if row["gaussians"] != START]
        found: Row = {"method": method}
        for name in ("seconds", "cpu_seconds"):
            counts, values = [row["gaussians"] for row in sizes], [row[name] for row in sizes]
            found[name] = slope(counts, values)
            found[f"{name}_beyond_start"] = slope(counts, [v - first[name] for v in values]) if first else None
        result.append(found)
    return result


def library_bytes() -> int:
    """Memory of the libraries alone, bytes: the least of three counts, as the system maps more of them at some times
    than at others."""
    return min(run_measured([sys.executable, "-c", IMPORTS]).peak_bytes or 0 for _ in range(3))


def tables(rows: list[Row], keep: float, libraries: int) -> Iterator[Table]:
    """Time and memory by size and program, in times of the first program's too; then the slopes."""
    lines = []
    for n, same in grouped(rows, lambda row: row["gaussians"]).items():
        ours = same[0]
        for row in same:
            if row["seconds"] is None:
                lines.append([f"{n:,}", row["method"], row["failed"][:40]])
                continue
            times = [row[key] / ours[key] if ours[key] else None for key in ("seconds", "peak_bytes")]
            ours_alone = (row["peak_bytes"] - row["file_bytes"] - libraries) / n
            beyond = number(0)(ours_alone) if row["method"] in WAYS and n > START else ""
            cells = [number(1)(row["seconds"]), number(1)(row["cpu_seconds"]), megabytes(row["peak_bytes"]), beyond]
            lines.append([f"{n:,}", row["method"], *cells, *map(number(2), times)])
    heads = ("Gaussians", "command", "s", "CPU s", "peak MB", "bytes a Gaussian", "times s", "times MB")
    title = f"to {keep:.0%}, from file to file; bytes a Gaussian: peak memory beyond the file's size and the libraries"
    yield table(title, heads, lines, left=["command"])
    names = {"seconds": "s", "seconds_beyond_start": "s beyond the start", "cpu_seconds": "CPU s"}
    names["cpu_seconds_beyond_start"] = "CPU s beyond the start"
    found = [[row["method"], *(number(2)(row[name]) for name in names)] for row in slopes(rows)]
    yield table("slope of log time over log Gaussians (1: linear)", ("command", *names.values()), found)


def main(
    gaussians: tuple[int, ...] = (100_000, 300_000, 1_000_000),
    ways: tuple[Way, ...] = ("prune",),
    splat_transform: tuple[str, ...] = (),
    sh_degree: int = 3,
    keep: float = KEEP,
    json: Path | None = None,
) -> None:
    """Print what making synthetic scenes smaller takes.

    Args:
        gaussians: sizes of the scenes.
        ways: prune, compact, and thorough: compact with that effort.
        splat_transform: programs, of any versions, each of whose modes is measured too.
        sh_degree: of the scenes.
        keep: share of the Gaussians that remains.
        json: write all rows there, after each.
    """
    rows: list[Row] = []
    for row in rows_of(gaussians, sh_degree, programs_of(ways, splat_transform), keep):
        rows.append(row)
        took = row["failed"] or f"{row['seconds']:.1f} s, {megabytes(row['peak_bytes'])} MB"
        print(f"{row['gaussians']:,} {row['method']}: {took}", flush=True)
        write_json(json, {"rows": rows, "slopes": slopes(rows)})
    console().print(*tables(rows, keep, library_bytes()))


if __name__ == "__main__":
    start(main)
