"""The levels of a streamed SOG beside `prune` of its finest level to the same counts.

    python -m lab.judge.levels HeadquarterGarden/lod-meta.json --name headquarter_garden --json levels.json

Both are compared with renders of the finest level along the camera path of that name.
"""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Annotated

import tyro

import pointsplat_ns as ps
from lab.common.printing import console, number, start, table
from lab.common.results import Row, write_json
from lab.judge.camera_paths import path_of, views_of
from lab.judge.scenes import DenseViews
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import read_scene
from pointsplat_ns.io.formats.sog_stream import coarser_levels


def main(
    stream: tyro.conf.Positional[Path],
    name: str,
    widths: tuple[int, ...] = (960, 1920),
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Print PSNR, mean over views and the worst, dB; and CPU seconds and the peak of memory so far of `prune`.

    Args:
        stream: lod-meta.json.
        name: of a camera path in ``lab/judge/paths``.
        widths: of the pictures, pixels.
        json_path: write all rows there.
    """
    views = {width: views_of(path_of(name), width) for width in widths}
    finest = read_scene(stream)
    judges = {width: DenseViews(finest, seen) for width, seen in views.items()}
    rows: list[Row] = []

    def judge(way: str, level: Gaussians, cpu: float | None) -> None:
        found = {width: judge.psnrs(level) for width, judge in judges.items()}
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        row: Row = {"way": way, "count": len(level), "cpu_seconds": cpu, "peak_gb": peak}
        for width, psnrs in found.items():
            row |= {f"mean_{width}": sum(psnrs) / len(psnrs), f"worst_{width}": min(psnrs)}
        rows.append(row)

    levels = coarser_levels(stream, len(finest))
    for level in levels:
        judge("its level", level, None)
    counts = [len(level) for level in levels]
    del levels
    for count in counts:
        begin = time.process_time()
        small = ps.prune(finest, count)
        judge("prune", small, time.process_time() - begin)
    write_json(json_path, rows)
    tenths = number(1)
    columns = [f"{what}_{width}" for width in widths for what in ("mean", "worst")]
    figures = (*columns, "cpu_seconds", "peak_gb")
    lines = [(row["way"], f"{row['count']:,}", *(tenths(row[name]) for name in figures)) for row in rows]
    title = f"{stream}: {len(finest):,} Gaussians, PSNR in {len(views[widths[0]])} views, dB"
    console().print(table(title, ("", "Gaussians", *columns, "CPU s", "GB"), lines))


if __name__ == "__main__":
    start(main)
