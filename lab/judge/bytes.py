"""What scenes are worth for their bytes: PSNR of files of equal sizes, ours and splat-transform's.

    python -m lab.judge.bytes scenes/rock.ply scenes/bouquet.ply --splat-transform
    node_modules/.bin/splat-transform \\
        --json docs/record/bytes.json --picture docs/record/bytes.png --resume

Ours are files of ``prune`` and ``compact`` with ``--keep SIZE``. splat-transform has no budgets in
bytes: its PLY of the count at which its file meets the size, found by trying, is converted. All
files are read by this package and compared along the camera path of the scene's name, as
``lab.judge.judge`` does.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, cast

import pandas as pd
import torch
import tyro

from lab.common.printing import console, save_figure, table
from lab.common.programs import run_measured
from lab.common.results import Results, Row, grouped
from lab.common.ways import PEER, SplatTransform, Way, pointsplat_command
from lab.judge.record import OURS
from lab.judge.scenes import JudgedScene, check, load, losses
from pointsplat_ns.scene.gaussians import Gaussians
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.system.progress import tracked


def files_of(
    scene: JudgedScene, source: Path, size: float, ways: tuple[str, ...], peer: SplatTransform
) -> Iterator[Row]:
    """Rows of all files of a size, megabytes, with the scene that each holds under ``small``."""
    for way in ways:
        name, _, suffix = way.rpartition(" ")
        with tempfile.TemporaryDirectory(dir=source.parent) as folder:
            target = Path(folder) / f"small{suffix}"
            if name == PEER:
                seconds = peer_file(peer, source, len(scene.dense), int(size * 1e6), target)
            else:
                seconds = run_measured(
                    pointsplat_command(cast(Way, name), source, f"{size:g}MB", target)
                ).cpu_seconds
            small = read_scene(target)
            about = {"scene": scene.name, "digest": scene.digest, "megabytes": size, "way": way}
            yield about | {
                "bytes": target.stat().st_size,
                "count": len(small),
                "cpu_seconds": seconds,
                "small": small,
            }


def peer_file(
    peer: SplatTransform, source: Path, gaussians: int, limit: int, target: Path
) -> float:
    """Write splat-transform's largest file of at most ``limit`` bytes, within 3 %; returns the CPU
    seconds of the last try."""
    low = 0
    high = gaussians + 1
    each = 20.0
    best = 0
    seconds = 0.0
    for _ in range(5):
        count = min(max(round(0.985 * limit / each), low + 1), high - 1, gaussians)
        decimated = target.with_suffix(".ply")
        seconds = run_measured(peer.modes[0].command(source, count, decimated)).cpu_seconds
        tried = target.with_name(f"tried{target.suffix}")
        seconds += run_measured(
            [*peer.command, "-w", "-g", "cpu", str(decimated), str(tried)]
        ).cpu_seconds
        size = tried.stat().st_size
        each = size / count
        if size <= limit:
            low = count
            if size > best:
                best = size
                tried.replace(target)
            if size >= 0.97 * limit or count == gaussians:
                break
        else:
            high = count
    if not best:
        raise SystemExit(f"{PEER}: no file of at most {limit} bytes found")
    return seconds


def leads(rows: list[Row]) -> pd.DataFrame:
    """dB that each of our ways is above the best file of splat-transform: rows by size and scene, a
    column a way."""
    table = pd.DataFrame(rows)
    table["name"] = table["way"].str.rsplit(" ", n=1).str[0]
    best = table.pivot_table(
        index=["megabytes", "scene"], columns="name", values="covered_psnr", aggfunc="max"
    )
    return best.reindex(columns=OURS).sub(best.get(PEER), axis=0).dropna(axis="columns", how="all")


def lead_table(rows: list[Row]) -> None:
    """Print the mean and the smallest lead for each size, where there are files of
    splat-transform."""
    if not any(row["way"].startswith(PEER) for row in rows):
        return
    lines = [
        (
            f"{size:g} MB",
            way,
            len(known),
            f"{known.mean():+.1f}",
            f"{known.min():+.1f} {known.idxmin()[1]}",
        )
        for size, same in leads(rows).groupby("megabytes")
        for way in same
        if len(known := same[way].dropna())
    ]
    heads = ("size", f"above {PEER}", "scenes", "mean", "worst")
    console().print(table("dB at equal bytes", heads, lines, (heads[1], "worst")))


def draw(rows: list[Row], path: Path) -> None:
    """Draw PSNR over bytes: a panel for each scene, a line for each way."""
    from matplotlib.figure import Figure

    scenes = list(grouped(rows, lambda row: row["scene"]).items())
    columns = min(4, len(scenes))
    sizes = sorted({row["megabytes"] for row in rows})
    lines = -(-len(scenes) // columns)
    figure = Figure(figsize=(3.6 * columns, 2.9 * lines), layout="constrained")
    colours = {"prune": "tab:blue", "compact": "tab:green", PEER: "tab:red"}
    for panel, (scene, own) in enumerate(scenes):
        axes = figure.add_subplot(lines, columns, panel + 1)
        for way, points in grouped(own, lambda row: row["way"]).items():
            points = sorted(points, key=lambda row: row["bytes"])
            name, _, suffix = way.rpartition(" ")
            axes.plot(
                [row["bytes"] / 1e6 for row in points],
                [row["covered_psnr"] for row in points],
                label=way,
                color=colours[name],
                linestyle="-" if suffix == ".sog" else "--",
                marker=".",
            )
        axes.set(
            title=scene,
            xscale="log",
            xlim=(0.8 * sizes[0], 1.25 * sizes[-1]),
            xlabel="MB",
            ylabel="dB",
        )
        axes.set_xticks(sizes, [f"{size:g}" for size in sizes])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=6)
    save_figure(figure, path)


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]] = (),
    megabytes: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0),
    ways: tuple[str, ...] = (
        "prune .sog",
        "compact .sog",
        "prune .spz",
        f"{PEER} .sog",
        f"{PEER} .spz",
    ),
    splat_transform: str | None = None,
    width: int = 960,
    views: int = 8,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    picture: Path | None = None,
) -> None:
    """Measure files of equal sizes.

    Args:
        scenes: PLY files that have a camera path of their name.
        megabytes: sizes of files. A scene whose PLY is smaller than four times a size is left out
            there.
        ways: what is measured, each a command and a format.
        splat_transform: the program; by default the one on PATH.
        width: of the pictures, pixels.
        views: at most so many views of each scene, evenly spread.
        json_path: write all rows there, after each scene.
        resume: take up the rows of that file; what it lacks is measured.
        picture: draw PSNR over bytes there.
    """
    peer = SplatTransform(splat_transform)
    if peer.missing and any(way.startswith(PEER) for way in ways):
        raise SystemExit(f"{PEER}: {peer.missing}")
    results = Results(json_path, {"views": views, "width": width, PEER: peer.version}, resume)
    for name, path in zip(check(scenes), scenes, strict=True):
        scene = load(path, (width,), views)
        known = [row for row in results.of(name) if row["digest"] == scene.digest]
        there = {(row["megabytes"], row["way"]) for row in known}
        for size in (size for size in megabytes if 4e6 * size <= path.stat().st_size):
            left = tuple(way for way in ways if (size, way) not in there)
            made = list(
                tracked(files_of(scene, path, size, left, peer), f"{name}: {size:g} MB", len(left))
            )
            smalls: list[Gaussians] = [row.pop("small") for row in made]
            for number, look, measures in losses(scene, smalls, None):
                known.append(made[number] | {"at": look.at, "views": len(look.views)} | measures)
            results.put(name, known)
    rows = results.rows
    heads = ("scene", "MB", "way", "bytes", "Gaussians", "dB", "CPU s")
    lines = (
        (
            r["scene"],
            r["megabytes"],
            r["way"],
            f"{r['bytes']:,}",
            f"{r['count']:,}",
            f"{r['covered_psnr']:.2f}",
            f"{r['cpu_seconds']:.0f}",
        )
        for r in sorted(rows, key=lambda row: (row["scene"], row["megabytes"], row["way"]))
    )
    console().print(table(f"PSNR at {width} pixels", heads, lines, ("way",)))
    lead_table(rows)
    if picture is not None:
        draw(rows, picture)


if __name__ == "__main__":
    tyro.cli(main)
