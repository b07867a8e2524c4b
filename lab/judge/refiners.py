"""What refiners gain over the pruned scene, in views that were chosen by hand: several of one kind,
such as seeds.

    python -m lab.judge.refiners scenes/rock.ply --refiners pointsplat=RUN1 pointsplat=RUN2
    paper-splatformer=RUN3 \\
        --by paper --keep 0.1 --json docs/record/encoders.json

A refiner is a run of ``ns-train pointsplat``, a .safetensors file, or ``shipped``. Residuals are
taken whole, and nothing checks them: ``pointsplat compact`` would leave out what does harm.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from pathlib import Path
from statistics import fmean, stdev
from typing import Annotated

import torch
import tyro

import pointsplat_ns as ps
from lab.common.printing import console, percent, start, table
from lab.common.results import Results, Row, grouped
from lab.judge.scenes import DenseViews, check, check_options, load

HEADS = ("refiner", "selection", "kept", "trainings", "gain, dB", "spread, dB")


def named(text: str) -> tuple[str, str]:
    """Name and file of a refiner, as in ``dual=RUN``."""
    name, separator, path = text.partition("=")
    if not (name and separator and path):
        raise SystemExit(f"--refiners {text}; expected NAME=RUN, NAME=FILE or NAME=shipped")
    return name, path


def gain(row: Row) -> float:
    """What the refiner of a row gains over the pruned scene, dB."""
    return float(row["psnr"] - row["pruned_psnr"])


def mean_and_spread(rows: Iterable[Row]) -> tuple[str, str]:
    """Cells of the mean of the gains of refiners over scenes, and of its standard deviation from
    refiner to refiner."""
    one_each = grouped(rows, lambda row: row["number"]).values()
    gains = [fmean(map(gain, of_one)) for of_one in one_each]
    return f"{fmean(gains):+.2f}", f"{stdev(gains):.2f}" if len(gains) > 1 else "-"


def lines(rows: Iterable[Row]) -> list[list[str]]:
    """Cells of :data:`HEADS` for each name, selection and budget: the number of refiners of the
    name, the mean of their gains over scenes, and the standard deviation of these means from
    refiner to refiner."""
    found = []
    groups = grouped(rows, lambda row: (row["method"], row["by"], row["keep"]))
    for (name, by, keep), members in groups.items():
        trainings = len({row["number"] for row in members})
        found.append([name, by, percent(keep), str(trainings), *mean_and_spread(members)])
    return found


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    refiners: tuple[str, ...],
    keep: tuple[float, ...] = (0.1,),
    by: tuple[str, ...] = ("paper",),
    width: int = 960,
    views: int = 6,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Print what refiners gain: PSNR over the pixels that the dense scene covers, against its
    renders.

    Args:
        scenes: PLY files that have a camera path of their name, and Splatfacto runs, judged in
            their held-out photos.
        refiners: NAME=RUN; those of one name are averaged.
        keep: shares of the Gaussians to keep.
        by: pruning methods.
        width: of the pictures of camera paths, pixels; the height is 9/16 of it.
        views: at most so many views of each scene, evenly spread.
        json_path: write all rows there, after each scene.
    """
    check_options(scenes, keep, views, (width,))
    asked = [named(text) for text in refiners]
    networks = {
        method: [(name, ps.load_refiner(path, by=method)) for name, path in asked] for method in by
    }
    results = Results(json_path, {"views": views, "width": width}, resume=False)
    for scene_name, path in zip(check(scenes), scenes, strict=True):
        scene = load(path, (width,), views)
        dense = DenseViews(scene.dense, scene.looks[0].views)
        rows = []
        for method, share in itertools.product(by, keep):
            small = ps.prune(scene.dense, keep=share, by=method)
            pruned = dense.psnr(small)
            for number, (name, network) in enumerate(networks[method]):
                row: Row = {
                    "scene": scene_name,
                    "digest": scene.digest,
                    "keep": share,
                    "by": method,
                    "method": name,
                }
                gained = dense.psnr(ps.refine(small, network))
                rows.append(
                    row
                    | {"number": number, "count": len(small), "pruned_psnr": pruned, "psnr": gained}
                )
        results.put(scene_name, rows)
        console().print(table(scene_name, HEADS, lines(rows), left=HEADS[:2]))
    console().print(table("mean over scenes", HEADS, lines(results.rows), left=HEADS[:2]))


if __name__ == "__main__":
    start(main)
