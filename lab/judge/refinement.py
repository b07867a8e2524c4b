"""What one pass of a network brings over a selection, beside the simplest control and the merge.

    python -m lab.judge.refinement scenes/rock.ply scenes/bouquet.ply --refiners shipped=shipped \\
        --keep 0.1 0.3 0.5 --json docs/record/refinement.json
    python -m lab.judge.refinement scenes/rock.ply outputs/office/splatfacto-cpu/RUN \\
        --refiners shipped=shipped --json docs/record/refinement.json

Each scene is pruned with the network's method. Renders of a PLY along a camera path written by hand
are compared with those of the dense scene, over the pixels that this covers; those of a run with
its held-out photos, in their size. The control adds one
constant to all log-scales of the selection: the best of :data:`CONSTANTS` for each scene and
budget, which knows the pictures that judge, as no network does. Residuals are taken whole, and nothing
checks them. The file is taken up: what it has of a scene is not measured again.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import tyro

import pointsplat_ns as ps
from lab.common.printing import console, markdown, percent, start, table
from lab.common.results import Results, Row, grouped, write_page
from lab.judge.refiners import named
from lab.judge.scenes import (
    PHOTOS,
    DenseViews,
    JudgedScene,
    PhotoViews,
    check,
    check_options,
    load,
)

CONSTANTS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, 1.2)
"""Natural logarithms added to all log-scales; the best of them is the control."""

SELECTION = "selection"
CONSTANT = "best constant"
MERGED = "merged"
"""Ways beside the networks'."""

HEADS = ("kept", "way", "PSNR, dB", "over the selection", "worst scene", "over the constant")

PAGE = """# What one pass of a network brings over a selection

`lab/judge/refinement.py` measured [{name}]({name}) and writes this page from it. The best constant
is one number added to all log-scales, chosen for each scene and budget by the pictures that judge:
a control that knows the answer. The worst scene is the one where a way gains least over the
selection. No network was trained on these scenes; the figures hold for them, at this size.
"""

AGAINST = {
    "renders": """
## Against renders of the dense scene

PSNR over the pixels that the dense scene covers, in {views} views of camera paths written by hand,
{width} pixels wide.

""",
    PHOTOS: """
## Against held-out photos

PSNR in at most {views} held-out photos of each capture, in their size.

""",
}
"""Heads of the parts of the page, by what rows were compared with."""


def measured(
    scene: JudgedScene,
    judge: DenseViews | PhotoViews,
    share: float,
    by: str,
    networks: dict[str, ps.TrainedRefiner],
    known: Iterable[str] = (),
) -> list[Row]:
    """Rows of a scene at one budget: of the selection, the control, the merge, and networks by
    name, without the ways that are known."""
    small = ps.prune(scene.dense, keep=share, by=by)
    grown = {add: small.replace(scales=small.scales + add) for add in CONSTANTS}
    kept = len(small) / len(scene.dense)
    ways: dict[str, Callable[[], ps.Gaussians]] = {
        SELECTION: lambda: small,
        CONSTANT: lambda: max(grown.values(), key=judge.psnr),
        MERGED: lambda: ps.prune(scene.dense, keep=share, by="merge"),
        **{name: functools.partial(refiner, small, kept) for name, refiner in networks.items()},
    }
    rows: list[Row] = []
    for way in ways:
        if way in known:
            continue
        begun = time.perf_counter()
        result = ways[way]()
        seconds = time.perf_counter() - begun
        each = judge.psnrs(result)
        against = PHOTOS if isinstance(judge, PhotoViews) else "renders"
        row: Row = {"scene": scene.name, "digest": scene.digest, "keep": share, "by": by}
        row["against"] = against
        row |= {"way": way, "count": len(result), "seconds": round(seconds, 2)}
        row |= {"psnr": round(fmean(each), 3), "worst_view": round(min(each), 3)}
        if way == CONSTANT:
            row["constant"] = next(add for add in CONSTANTS if grown[add] is result)
        rows.append(row)
    return rows


def lines(rows: Iterable[Row]) -> list[list[str]]:
    """Cells of :data:`HEADS`: means over scenes, for each budget and way."""
    found = []
    for keep, of_keep in grouped(rows, lambda row: row["keep"]).items():
        ways = grouped(of_keep, lambda row: row["way"])
        first = {row["scene"]: row["psnr"] for row in ways[SELECTION]}
        control = {row["scene"]: row["psnr"] for row in ways[CONSTANT]}
        for way, members in ways.items():
            gains = {row["scene"]: row["psnr"] - first[row["scene"]] for row in members}
            worst = min(gains, key=lambda name: gains[name])
            over = fmean(row["psnr"] - control[row["scene"]] for row in members)
            mean = fmean(row["psnr"] for row in members)
            same = way == SELECTION
            found.append(
                [
                    percent(keep),
                    way,
                    f"{mean:.2f}",
                    "-" if same else f"{fmean(gains.values()):+.2f}",
                    "-" if same else f"{gains[worst]:+.2f} ({worst})",
                    f"{over:+.2f}",
                ]
            )
    return found


def each_scene(rows: list[Row]) -> str:
    """A table of PSNR by scene and budget, a column for each way."""
    ways = list(grouped(rows, lambda row: row["way"]))
    cells = []
    for (scene, keep), members in grouped(rows, lambda row: (row["scene"], row["keep"])).items():
        by_way = {row["way"]: row["psnr"] for row in members}
        cells.append(
            [scene, percent(keep)]
            + [f"{by_way[way]:.2f}" if way in by_way else "-" for way in ways]
        )
    return markdown(["scene", "kept", *ways], cells)


def page(rows: list[Row], name: str, views: int, width: int) -> str:
    """The Markdown page of all rows."""
    text = PAGE.format(name=name)
    parts = grouped(rows, lambda row: row["against"])
    for against, head in AGAINST.items():
        of_kind = parts.get(against, [])
        if of_kind:
            text += head.format(views=views, width=width)
            text += markdown(HEADS, lines(of_kind)) + "\n\n" + each_scene(of_kind) + "\n"
    return text


@torch.no_grad()
def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    refiners: tuple[str, ...] = (),
    keep: tuple[float, ...] = (0.1, 0.3, 0.5),
    by: str = "paper",
    width: int = 960,
    views: int = 12,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Measure networks beside the selection, the best constant on log-scales and the merge.

    Args:
        scenes: PLY files that have a camera path of their name, and Splatfacto runs, judged in
            their held-out photos.
        refiners: NAME=RUN, NAME=FILE or NAME=shipped.
        keep: shares of the Gaussians to keep.
        by: pruning method.
        width: of the pictures of camera paths, pixels; the height is 9/16 of it.
        views: at most so many views of each scene, evenly spread.
        json_path: write all rows there, after each scene, and the page of its name beside it.
    """
    check_options(scenes, keep, views, (width,))
    networks = {name: ps.load_refiner(path, by=by) for name, path in map(named, refiners)}
    settings = {"views": views, "width": width}
    results = Results(json_path, settings, resume=json_path is not None)
    for scene_name, path in zip(check(scenes), scenes, strict=True):
        scene = load(path, (width,), views)
        known = [row for row in results.of(scene_name) if row["digest"] == scene.digest]
        look = scene.looks[0]
        judge = PhotoViews(look) if look.photos else DenseViews(scene.dense, look.views)
        for share in keep:
            there = {row["way"] for row in known if row["keep"] == share and row["by"] == by}
            new = measured(scene, judge, share, by, networks, there)
            known = known + new
            results.put(scene_name, known)
        console().print(table(scene_name, HEADS, lines(known), left=HEADS[:2]))
    for against, rows in grouped(results.rows, lambda row: row["against"]).items():
        title = f"mean over scenes, against {against}"
        console().print(table(title, HEADS, lines(rows), left=HEADS[:2]))
    if json_path is not None:
        write_page(json_path, lambda rows: page(rows, json_path.name, views, width))


if __name__ == "__main__":
    start(main)
