"""What poses are worth: a trained run is made smaller without poses, with all of its training poses, and with every
third.

    python -m lab.judge.without_poses outputs/meeting/splatfacto-cpu/RUN --json without_poses.json --resume
    python -m lab.judge.without_poses RUN --keep 0.1 --ways prune --sets sampled all

The run's PLY, exported to a folder of its own, is merged (``prune``) and repaired (``compact``), and compared with
renders of the dense scene in the poses of held-out photos: at the photos' size, and at twice it. For each set of views,
the rank correlation of visibility weights with minus the log of the size of Gaussians, and the median weight, say how
well the views explain the scene; no held-out pose has a part in that.

``lab/judge/captures.py`` lists the captures, and how each is made ready and trained. Choose constants on those for
tuning.
"""

from __future__ import annotations

import dataclasses
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path
from typing import Annotated, Literal

import pandas as pd
import torch
import tyro

import pointsplat_ns as ps
from lab.common.printing import console, number, percent, start, table
from lab.common.results import Results, Row
from lab.common.scenes import group_of
from lab.common.ways import WAYS, Way, count_of
from lab.judge.scenes import LEAST_WIDTH, DenseViews, JudgedScene, check, check_options, known_rows, load
from pointsplat_ns.errors import SceneError
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.io import write_ply
from pointsplat_ns.looking.view_source import VIEW_COUNTS
from pointsplat_ns.merging import MERGING
from pointsplat_ns.merging.rounds import views_and_weights
from pointsplat_ns.merging.state import Participants, drawable
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.system.progress import tracked
from pointsplat_ns.system.threads import one_thread_each
from pointsplat_ns.views import Views

ViewSet = Literal["sampled", "all", "third"]
"""No poses; all training poses; every third of them."""

SETS: tuple[ViewSet, ...] = ("sampled", "all", "third")

DB = number(2)

SIZES = {"psnr": 1, "twice_psnr": 2}
"""Measures by name, and the size of their pictures in sizes of the photos."""

WEIGHTS = "weights"
"""In place of a way: the row says how a set of views explains the scene."""

OPAQUE = 0.1
"""Least opacity of the Gaussians whose weights and sizes are compared."""

DIFFERENCES = {
    "prune: sampled - all": ("prune, sampled", "prune, all"),
    "compact: sampled - third": ("compact, sampled", "compact, third"),
    "compact: sampled - all": ("compact, sampled", "compact, all"),
    "sampled: compact - prune": ("compact, sampled", "prune, sampled"),
    "all: compact - prune": ("compact, all", "prune, all"),
}
"""What is compared with what, each a way and a set of views."""

Task = tuple[float | None, str, ViewSet]
"""A share to keep, None for weights; a way, or :data:`WEIGHTS`; a set of views."""


def doubled(views: Views) -> Views:
    """The same views at twice the size."""
    scale = views.Ks.new_tensor([[2.0], [2.0], [1.0]])
    return dataclasses.replace(views, Ks=views.Ks * scale, width=2 * views.width, height=2 * views.height)


def chosen(name: ViewSet, poses: Views) -> Views | None:
    """The views of a set, of a run's training poses; None for sampled ones."""
    return None if name == "sampled" else poses if name == "all" else poses[::3]


@torch.no_grad()
def explained(scene: Gaussians, views: Views | None) -> dict[str, float | None]:
    """How views explain the sizes of a scene's Gaussians.

    Args:
        scene: N Gaussians on the CPU.
        views: of the scene; None for those that merging samples.

    Returns:
        ``correlation``: Spearman's rank correlation of visibility weights with minus the log of the root of the two
        larger standard deviations, over Gaussians of opacity above :data:`OPAQUE`; None if weights or sizes are all
        equal. ``median`` of the weights, relative to a Gaussian that is seen well.
    """
    from scipy.stats import rankdata

    known = None if views is None else views.spread(VIEW_COUNTS.weighed)
    with one_thread_each():
        participants = Participants.of(scene, drawable(scene, 1))
        _, weights = views_and_weights(participants, known, MERGING)
    opaque = scene.alphas[participants.members] > OPAQUE
    members, weights = participants.members[opaque], weights[opaque].double()
    if len(weights) == 0:
        return {"correlation": None, "median": None}
    logs = scene.scales[members].double().sort(dim=1).values[:, 1:].mean(1)
    ranks = torch.stack([torch.from_numpy(rankdata(values.numpy())) for values in (weights, -logs)])
    varies = bool((ranks != ranks[:, :1]).any(1).all())
    correlation = float(torch.corrcoef(ranks)[0, 1]) if varies else None
    return {"correlation": correlation, "median": float(weights.median())}


def task_of(row: Row) -> Task:
    """The task that a row is of."""
    return row["keep"], row["method"], row["views"]


def rows_of(scene: JudgedScene, path: Path, tasks: list[Task]) -> Iterator[Row]:
    """One row for each task."""
    poses = dataset_views(path, "train")
    [look] = scene.looks
    judges: dict[str, DenseViews] = {}
    with tempfile.TemporaryDirectory() as folder:
        ply = Path(folder) / f"{scene.name}.ply"
        write_ply(scene.dense, ply)
        for keep, method, name in tasks:
            row: Row = {"scene": scene.name, "digest": scene.digest, "gaussians": len(scene.dense)}
            row |= {"keep": keep, "method": method, "views": name, "poses": len(poses)}
            views = chosen(name, poses)
            if keep is None:
                yield row | explained(scene.dense, views)
                continue
            if not judges:
                sizes = {"psnr": look.views, "twice_psnr": doubled(look.views)}
                judges = {measure: DenseViews(scene.dense, seen) for measure, seen in sizes.items()}
            begin = time.process_time()
            small = _made(ply, count_of(keep, len(scene.dense)), method, views)
            row |= {"count": len(small), "cpu_seconds": time.process_time() - begin}
            yield row | {measure: judge.psnr(small) for measure, judge in judges.items()}


def _made(ply: Path, count: int, way: str, views: Views | None) -> Gaussians:
    if way == "prune":
        return ps.prune(ply, count, views=views)
    return ps.compact(ply, count, effort="thorough" if way == "thorough" else "quick", views=views).scene


def wide(rows: list[Row]) -> pd.DataFrame:
    """PSNR by share, measure and scene (rows), and by way with set of views (columns)."""
    table = pd.DataFrame([row for row in rows if row["method"] != WEIGHTS])
    table["way"] = table["method"] + ", " + table["views"]
    long = table.melt(["keep", "scene", "way"], list(SIZES), var_name="measure", value_name="dB")
    return long.pivot(index=["keep", "measure", "scene"], columns="way", values="dB")


def differences(rows: list[Row]) -> list[Row]:
    """The :data:`DIFFERENCES` of each group of scenes, share and size: the mean over scenes, the worst, and its
    scene."""
    values, found = wide(rows), []
    for name, (of, to) in DIFFERENCES.items():
        if {of, to} <= {*values.columns}:
            known = (values[of] - values[to]).dropna().reset_index(name="dB").set_index("scene")
            groups = known.index.map(lambda scene: group_of(scene) or "other")
            for (keep, measure, group), same in known.groupby(["keep", "measure", groups])["dB"]:
                about = {"group": group, "scenes": len(same), "keep": keep, "measure": measure, "difference": name}
                found.append(about | {"mean": same.mean(), "worst": same.min(), "worst_scene": same.idxmin()})
    return found


def show(rows: list[Row]) -> None:
    """Print a table for each share and size, with the mean and the worst over scenes; then weights and differences."""
    values = wide(rows)
    order = [way for way in (f"{way}, {views}" for way, views in product(WAYS, SETS)) if way in values.columns]
    for (keep, measure), same in values[order].groupby(["keep", "measure"]):
        of_all = same.dropna()
        lines = [(scene, *map(DB, line)) for (*_, scene), line in zip(same.index, same.to_numpy(), strict=True)]
        lines += [("mean", *map(DB, of_all.mean())), ("worst", *map(DB, of_all.min()))]
        title = f"{percent(keep)}: PSNR at {SIZES[measure]} x the photos' size, dB"
        console().print(table(title, ("scene", *order), lines))
    weights = {(row["scene"], row["views"]): row for row in rows if row["method"] == WEIGHTS}
    lines = [
        (scene, *(" / ".join((DB(row.get("correlation")), number(4)(row.get("median")))) for row in same))
        for scene in dict.fromkeys(row["scene"] for row in rows)
        for same in [[weights.get((scene, name), {}) for name in SETS]]
    ]
    console().print(table("weights: rank correlation with minus log size / median", ("scene", *SETS), lines))
    lines = [
        (f"{row['group']}, {row['scenes']}", percent(row["keep"]), f"x {SIZES[row['measure']]}")
        + (row["difference"], DB(row["mean"]), DB(row["worst"]), row["worst_scene"])
        for row in differences(rows)
    ]
    heads = ("scenes", "kept", "size", "difference", "mean, dB", "worst, dB", "of")
    console().print(table("what views without poses cost", heads, lines, left=("difference", "of")))


def main(
    runs: tyro.conf.Positional[tuple[Path, ...]],
    keep: tuple[float, ...] = (0.1, 0.3),
    ways: tuple[Way, ...] = ("prune", "compact"),
    sets: tuple[ViewSet, ...] = SETS,
    views: int = 12,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    resume: bool = False,
    again: tuple[ViewSet, ...] = (),
) -> None:
    """Print what is lost without poses, with all training poses, and with every third.

    Args:
        runs: trained Splatfacto runs with held-out photos.
        keep: shares of the Gaussians to keep.
        ways: how scenes are made smaller: prune, compact, thorough.
        sets: views that are given: sampled (none), all training poses, every third of them.
        views: at most so many held-out poses of each run, evenly spread.
        json_path: write all rows there, after each.
        resume: take up the rows of that file. What it lacks is measured.
        again: sets of views that are measured though the file has them.
    """
    check_options(runs, keep, views, (LEAST_WIDTH,))
    if others := [path for path in runs if path.suffix == ".ply"]:
        raise SceneError(f"{others[0]}: a PLY; expected a run, whose dataset has the poses")
    names = check(runs)
    results = Results(json_path, {"views": views}, resume)
    for name, path in zip(names, runs, strict=True):
        scene = load(path, (), views)
        rows = {task_of(row): row for row in known_rows(results, scene)}
        wanted: list[Task] = [(None, WEIGHTS, name) for name in sets] + list(product(keep, ways, sets))
        tasks = [task for task in wanted if task not in rows or task[-1] in again]
        print(f"{name}: {len(scene.dense):,} Gaussians, {len(scene.looks[0].views)} held-out poses", flush=True)
        for row in tracked(rows_of(scene, path, tasks), name, len(tasks)):
            rows[task_of(row)] = row
            results.put(name, [*rows.values()])
    show([row for name in names for row in results.of(name)])


if __name__ == "__main__":
    start(main)
