"""What is lost when a scene is made smaller, by every method at hand, before any refinement.

    python benchmarks/compaction.py outputs/kitchen/splatfacto-cpu/TIME scene.ply --json compaction.json
    python benchmarks/compaction.py RUN --sweep          # lambda from 0.1 to 0.9 of the scores "paper" and "authors"
    python benchmarks/compaction.py --speed              # 1M synthetic Gaussians: seconds and peak memory

Renders are compared with the dense scene's own and, for runs, with held-out photos, at the size that the run was
trained at; a PLY is looked at from poses sampled in its free space. With Node and @playcanvas/splat-transform
(``npm install @playcanvas/splat-transform``) its ``--decimate`` is a row too, at the same counts in the same run.
"""

from __future__ import annotations

import json
import math
import resource
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import tyro
from held_out import COLUMNS, Scene, compare, load, lpips_or_none
from rich.console import Console
from rich.table import Table
from splat_transform import NAME, SplatTransform

from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import write_ply
from pointsplat_ns.metrics import psnr
from pointsplat_ns.metrics.lpips import Lpips
from pointsplat_ns.pruning import METHODS, prune

NEED_NO_VIEWS = tuple(name for name, method in METHODS.items() if not method.needs_views)
SWEEP = tuple(round(0.1 * i, 1) for i in range(1, 10))


def rows_of(
    scene: Scene, keeps: tuple[float, ...], methods: tuple[str, ...], peer: SplatTransform, lpips: Lpips | None
) -> Iterator[dict]:
    """One row for each budget and method."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "dense.ply"
        if not peer.missing:
            write_ply(scene.dense, source)
        for keep in keeps:
            count = max(1, round(keep * len(scene.dense)))
            for method in methods:
                start = time.perf_counter()
                small = prune(scene.dense, count, method)
                seconds = time.perf_counter() - start
                yield _row(scene, keep, method, small, seconds, lpips)
            if not peer.missing:
                small, seconds = peer.decimate(source, count)
                yield _row(scene, keep, peer.label, small, seconds, lpips)


def sweep_rows(scene: Scene, keeps: tuple[float, ...], lpips: Lpips | None) -> Iterator[dict]:
    """The paper's Table 3: the weight of opacity against that of volume."""
    for keep in keeps:
        for method in ("paper", "authors"):
            for weight in SWEEP:
                start = time.perf_counter()
                small = prune(scene.dense, keep, method, opacity_weight=weight)
                seconds = time.perf_counter() - start
                yield _row(scene, keep, f"{method} {weight}", small, seconds, lpips)


def _row(scene: Scene, keep: float, method: str, small: Gaussians, seconds: float, lpips: Lpips | None) -> dict:
    metrics = compare(scene, small, lpips)
    return {"scene": scene.name, "keep": keep, "method": method, "count": len(small), "seconds": seconds, **metrics}


def averages(rows: list[dict]) -> list[dict]:
    """Over scenes, for each budget and method."""
    grouped: dict[tuple, list[dict]] = {}
    for row in rows:
        grouped.setdefault((row["keep"], row["method"]), []).append(row)
    result = []
    for (keep, method), group in grouped.items():
        mean = {"scene": "average", "keep": keep, "method": method}
        for name in group[0].keys() - mean.keys():
            values = [row[name] for row in group if row[name] is not None]
            mean[name] = fmean(values) if values else None
        result.append(mean)
    return result


def table(rows: list[dict]) -> Table:
    """A rich table; a dash for what cannot be had."""
    shown = Table(title="against the dense scene's renders | against held-out photos")
    for name in ("scene", "kept", "method", "splats", "s"):
        shown.add_column(name, justify="left" if name in ("scene", "method") else "right")
    for against in ("dense", "photo"):
        for name in COLUMNS:
            shown.add_column(f"{against} {name.upper()}", justify="right")
    before = None
    for row in rows:
        key = (row["scene"], row["keep"])
        if before not in (None, key):
            shown.add_section()
        numbers = [
            "-" if row[f"{a}_{c}"] is None else f"{row[f'{a}_{c}']:.{2 if c == 'psnr' else 3}f}"
            for a in ("dense", "photo")
            for c in COLUMNS
        ]
        start = [row["scene"], f"{100 * row['keep']:g} %"] if before != key else ["", ""]
        shown.add_row(*start, row["method"], f"{row['count']:,.0f}", f"{row['seconds']:.2f}", *numbers)
        before = key
    return shown


def synthetic(n: int, seed: int = 0) -> Gaussians:
    """``n`` flat Gaussians of degree 3 on the walls of a room, of smooth colours and mixed sizes."""
    g = torch.Generator().manual_seed(seed)
    means = 2 * torch.rand(n, 3, generator=g) - 1
    wall = torch.randint(0, 3, (n,), generator=g)
    means[torch.arange(n), wall] = means[torch.arange(n), wall].sign() + 0.005 * torch.randn(n, generator=g)
    scales = math.log(4 / math.sqrt(n)) + 0.6 * torch.randn(n, 3, generator=g)
    scales[torch.arange(n), wall] -= 2.0
    quats = torch.tensor([1.0, 0, 0, 0]) + 0.1 * torch.randn(n, 4, generator=g)
    colours = torch.sin(3 * means) + 0.2 * torch.randn(n, 3, generator=g)
    rest = 0.05 * torch.randn(n, 15, 3, generator=g)
    return Gaussians(means, scales, quats, torch.randn(n, 1, generator=g), colours, rest)


def speed(gaussians: int) -> None:
    """Time of every score (median of 5) and of merging to a tenth, with the peak of the process's memory."""
    scene = synthetic(gaussians)
    print(f"{gaussians:,} Gaussians of SH degree 3 on {torch.get_num_threads()} threads")
    for name in NEED_NO_VIEWS:
        score, times = METHODS[name].score, []
        if score is None:
            continue
        for _ in range(5):
            start = time.perf_counter()
            score(scene)
            times.append(time.perf_counter() - start)
        print(f"  {name:12s} {sorted(times)[2]:7.3f} s")
    before = _peak_gigabytes()
    start = time.perf_counter()
    merged = prune(scene, max(1, gaussians // 10), "merge")
    seconds = time.perf_counter() - start
    peak = f"peak memory {_peak_gigabytes():.2f} GB ({before:.2f} GB before)"
    print(f"  merge to {len(merged):,} {seconds:.1f} s, {peak}")


def _peak_gigabytes() -> float:
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / (1e9 if sys.platform == "darwin" else 1e6)  # bytes there, kilobytes elsewhere


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    keep: tuple[float, ...] = (0.5, 0.3, 0.1, 0.03),
    methods: tuple[str, ...] = NEED_NO_VIEWS,
    views: int = 8,
    splat_transform: str | None = None,
    lpips: bool = True,
    sweep: bool = False,
    speed_only: Annotated[bool, tyro.conf.arg(name="speed")] = False,
    gaussians: int = 1_000_000,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Print tables of what every method loses.

    Args:
        scenes: Splatfacto runs, judged in their held-out views, and PLY files.
        keep: shares of the Gaussians to keep.
        methods: rows.
        views: at most so many views of each scene.
        splat_transform: the program, if ``npx --no-install splat-transform`` does not find it.
        lpips: whether to compute LPIPS.
        sweep: the scores "paper" and "authors" over their lambda, in place of all methods.
        speed_only: only measure time and memory, on synthetic Gaussians.
        gaussians: how many of these.
        json_path: write all rows there.
    """
    if speed_only:
        speed(gaussians)
        return
    if not scenes:
        raise SystemExit("no scene named; expected runs or PLY files, or --speed")
    network = lpips_or_none(lpips)
    peer = SplatTransform(splat_transform) if not sweep else None
    rows: list[dict] = []
    console = Console(width=None if sys.stdout.isatty() else 150)
    for path in scenes:
        scene = load(path, views)
        found = list(sweep_rows(scene, keep, network) if peer is None else rows_of(scene, keep, methods, peer, network))
        against = f", dense against photos {_dense_psnr(scene):.2f} dB" if scene.photos else ""
        print(f"{scene.name}: {len(scene.dense):,} Gaussians, {len(scene.renders)} views{against}")
        console.print(table(found))
        rows += found
    mean = averages(rows)
    if len(scenes) > 1:
        console.print(table(mean))
    if peer is not None and peer.missing:
        print(f"{NAME}: - ({peer.missing})")
    if json_path is not None:
        json_path.write_text(json.dumps({"rows": rows, "averages": mean}, indent=1), "utf-8")


def _dense_psnr(scene: Scene) -> float:
    return fmean(float(psnr(a, b)) for a, b in zip(scene.renders, scene.photos or [], strict=True))


if __name__ == "__main__":
    tyro.cli(main)
