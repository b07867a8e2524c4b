"""How time and memory of making a scene smaller grow with its Gaussians, on synthetic scenes."""

from __future__ import annotations

import math
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import torch
from rich.table import Table

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import write_ply
from pointsplat_ns.pruning import METHODS, ply_bytes
from pointsplat_ns.system.programs import ProgramFailed
from pointsplat_ns.tables.splat_transform import Reducer

Row = dict[str, Any]

KEEP = 0.1

START = 1000
"""Gaussians of the scene that shows what starting a program costs."""

HELD_BY_WRITING = 2.5
"""Memory that making and writing a scene takes, in sizes of its file: the tensors, one copy, the records."""


def synthetic(n: int, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """``n`` flat Gaussians on the walls of a room, of smooth colours and mixed sizes."""
    g = torch.Generator().manual_seed(seed)
    means = 2 * torch.rand(n, 3, generator=g) - 1
    wall = torch.randint(0, 3, (n,), generator=g)
    means[torch.arange(n), wall] = means[torch.arange(n), wall].sign() + 0.005 * torch.randn(n, generator=g)
    scales = math.log(4 / math.sqrt(n)) + 0.6 * torch.randn(n, 3, generator=g)
    scales[torch.arange(n), wall] -= 2.0
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(n, 4, generator=g)
    colours = torch.sin(3 * means) + 0.2 * torch.randn(n, 3, generator=g)
    rest = torch.randn(n, (sh_degree + 1) ** 2 - 1, 3, generator=g).mul_(0.05)
    return Gaussians(means, scales, quats, torch.randn(n, 1, generator=g), colours, rest)


def scaling_rows(counts: tuple[int, ...], sh_degree: int, programs: list[Reducer]) -> Iterator[Row]:
    """What each program takes for each size of scene, to a tenth, from file to file, the smallest first.

    A size that is expected to need more memory or disk than is free is left out; ``failed`` says so.
    """
    before: dict[str, Row] = {}
    for n in (START, *sorted(counts)):
        with tempfile.TemporaryDirectory() as folder:
            source = Path(folder) / "dense.ply"
            size = ply_bytes(n, sh_degree)
            no_room = _more_than("disk", (1 + KEEP) * size, shutil.disk_usage(folder).free)
            no_room = no_room or _more_than("memory", HELD_BY_WRITING * size, psutil.virtual_memory().available)
            if not no_room:
                write_ply(synthetic(n, sh_degree=sh_degree), source)
            for program in programs:
                row: Row = {"method": program.label, "gaussians": n, "sh_degree": sh_degree, "file_bytes": size}
                row |= {"count": None, "seconds": None, "cpu_seconds": None, "peak_bytes": None}
                expected = _expected_bytes(before.get(program.label), n)
                row["failed"] = no_room or _more_than("memory", expected, psutil.virtual_memory().available)
                if not row["failed"]:
                    try:
                        small, usage = program.reduce(source, max(1, round(KEEP * n)))
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


def slope(counts: list[int], seconds: list[float]) -> float | None:
    """Least-squares slope of log time over log count: 1 where time is linear. Times that are not positive are left out;
    None where fewer than two counts remain."""
    points = [(math.log(n), math.log(s)) for n, s in zip(counts, seconds, strict=True) if n > 0 and s > 0]
    if len({x for x, _ in points}) < 2:
        return None
    x, y = torch.tensor(points, dtype=torch.float64).unbind(1)
    x, y = x - x.mean(), y - y.mean()
    return float((x * y).sum() / (x * x).sum())


def slopes(rows: list[Row]) -> list[Row]:
    """For each program, the slope of its seconds and CPU seconds, as they are and beyond those of the start."""
    result = []
    for method in dict.fromkeys(row["method"] for row in rows):
        done = [row for row in rows if row["method"] == method and row["seconds"] is not None]
        start = next((row for row in done if row["gaussians"] == START), None)
        sizes = [row for row in done if row["gaussians"] != START]
        found: Row = {"method": method}
        for name in ("seconds", "cpu_seconds"):
            counts, values = [row["gaussians"] for row in sizes], [row[name] for row in sizes]
            found[name] = slope(counts, values)
            found[f"{name}_beyond_start"] = slope(counts, [v - start[name] for v in values]) if start else None
        result.append(found)
    return result


def scaling_table(rows: list[Row]) -> Table:
    """Time and memory by program and size, and how many times the seconds and the memory of our first program others
    take."""
    shown = Table(title=f"to {KEEP:.0%}, from file to file; kB a Gaussian: peak memory beyond the file's size")
    for name in (
        "Gaussians",
        "method",
        "s",
        "CPU s",
        "peak MB",
        "kB a Gaussian",
        "... beyond start",
        "times s",
        "times MB",
    ):
        shown.add_column(name, justify="left" if name == "method" else "right")
    starts = {row["method"]: row for row in rows if row["gaussians"] == START and row["seconds"] is not None}
    for n in dict.fromkeys(row["gaussians"] for row in rows):
        same = [row for row in rows if row["gaussians"] == n]
        ours = same[0]
        for row in same:
            name = f"{n:,}" if row is ours else ""
            if row["seconds"] is None:
                shown.add_row(name, row["method"], row["failed"][:40], end_section=row is same[-1])
                continue
            beyond = row["peak_bytes"] - row["file_bytes"]
            start = starts.get(row["method"])
            less = "-" if start is None or n == START else f"{(beyond - start['peak_bytes']) / n / 1e3:.2f}"
            versus = [
                "-" if row is ours or not ours[key] else f"{row[key] / ours[key]:.2f}"
                for key in ("seconds", "peak_bytes")
            ]
            cells = [f"{row['seconds']:.1f}", f"{row['cpu_seconds']:.1f}", f"{row['peak_bytes'] / 1e6:,.0f}"]
            each = "-" if n == START else f"{beyond / n / 1e3:.2f}"
            shown.add_row(name, row["method"], *cells, each, less, *versus, end_section=row is same[-1])
    return shown


def slope_table(found: list[Row]) -> Table:
    """The slopes of :func:`slopes`."""
    shown = Table(title="slope of log time over log Gaussians (1: linear)")
    names = {
        "seconds": "s",
        "seconds_beyond_start": "s beyond start",
        "cpu_seconds": "CPU s",
        "cpu_seconds_beyond_start": "CPU s beyond start",
    }
    for name in ("method", *names.values()):
        shown.add_column(name, justify="left" if name == "method" else "right")
    for row in found:
        shown.add_row(row["method"], *("-" if row[name] is None else f"{row[name]:.2f}" for name in names))
    return shown


def print_score_times(n: int, sh_degree: int) -> None:
    """Time of every score that needs no views, within this process, median of 5."""
    scene = synthetic(n, sh_degree=sh_degree)
    print(f"{n:,} Gaussians of SH degree {sh_degree} on {torch.get_num_threads()} threads")
    for name, method in METHODS.items():
        if method.needs_views or method.score is None:
            continue
        times = []
        for _ in range(5):
            start = time.perf_counter()
            method.score(scene)
            times.append(time.perf_counter() - start)
        print(f"  {name:12s} {sorted(times)[2]:7.3f} s")
