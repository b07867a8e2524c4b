"""What networks bring to repairs of a number of steps, beside plain Adam.

    python -m lab.judge.repairs scenes/rock.ply scenes/bouquet.ply --networks new=NET.safetensors \\
        --steps 48 192 600 --json docs/record/repairs.json

Each scene is merged, and repaired by each network for each number of steps; nothing accepts or
rejects the result. Renders along a camera path written by hand are compared with those of the dense
scene, over the pixels that this covers. All repairs of a scene take the same views in the same
order and take turns, so that a busy machine hits all alike; a render of the dense scene is drawn
once, and its CPU seconds are added to each repair that uses it. The file is taken up: what it has
of a scene is not measured again.
"""

from __future__ import annotations

import functools
import itertools
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import tyro

import pointsplat_ns as ps
from lab.common.printing import console, markdown, start, table
from lab.common.results import Results, Row, grouped, write_page
from lab.judge.refiners import named
from lab.judge.scenes import DenseViews, JudgedScene, check, check_options, load
from pointsplat_ns.pipeline.feedback_features import REPAIR, Feedback
from pointsplat_ns.pipeline.optimiser import optimised
from pointsplat_ns.pipeline.photos.examples import Example, render_of
from pointsplat_ns.pipeline.repair import initial_rate_factor
from pointsplat_ns.pipeline.view_provider import ViewProvider
from pointsplat_ns.refinement.feedback import (
    FeedbackRefiner,
    read_feedback_refiner,
    shipped_feedback_refiner,
)
from pointsplat_ns.refinement.schedules import cosine_factor
from pointsplat_ns.rendering.comparison.closeness import DenseReference

MERGED = "merged"
ADAM = "Adam"
SHIPPED = "shipped"
"""Ways beside the named networks': no step, steps without a network, and with the one that
ships."""

HEADS = ("steps", "way", "PSNR, dB", "over the merge", "worst scene", "over shipped", "CPU s")

PAGE = """# What networks bring to repairs

`lab/judge/repairs.py` measured [{name}]({name}) and writes this page from it. Each scene is merged
to {keep:g} % and repaired for a number of steps. PSNR is against renders of the dense scene, over
the pixels that it covers, in {views} views of camera paths written by hand, {width} pixels wide.
The worst scene is the one where a way gains least over the shipped network at as many steps (for
the shipped one: over the merge). CPU seconds are those of a repair with its renders of the dense
scene, on one thread of a shared machine: compare their ratios.

"""


@dataclass(eq=False)
class SharedExamples:
    """The views of a scene's repairs with renders of the dense scene, in the order of
    :func:`~pointsplat_ns.pipeline.repair.repair`; drawn once for all repairs."""

    dense: ps.Gaussians
    views: ViewProvider
    _order: list[ps.View] = field(default_factory=list)
    _drawn: dict[int, tuple[Example, float]] = field(default_factory=dict)  # by view identity

    def __post_init__(self) -> None:
        self._more = self.views.others()

    def _view(self, index: int) -> ps.View:
        while len(self._order) <= index:
            self._order.append(next(self._more))
        return self._order[index]

    def _example(self, index: int) -> Example:
        view = self._view(index)
        if id(view) not in self._drawn:
            begun = time.process_time()
            example = render_of(self.dense, view)
            self._drawn[id(view)] = example, time.process_time() - begun
        return self._drawn[id(view)][0]

    def draw(self, count: int) -> float:
        """Draw the first ``count`` examples. Returns the CPU seconds that these take alone."""
        for index in range(count):
            self._example(index)
        different = {id(self._view(index)) for index in range(count)}
        return sum(self._drawn[view][1] for view in different)

    def __iter__(self) -> Iterator[Callable[[], Example]]:
        return (functools.partial(self._example, index) for index in itertools.count())


def repaired(
    scene: ps.Gaussians,
    dense_count: int,
    examples: Iterable[Callable[[], Example]],
    steps: int,
    network: FeedbackRefiner | None,
    psnr: float,
) -> ps.Gaussians:
    """A scene of few Gaussians after :func:`~pointsplat_ns.pipeline.repair.repair` with any number
    of steps; arguments as there."""
    feedback = Feedback(scene, dense_count)
    taken = itertools.count()

    def choose(now: ps.Gaussians) -> tuple[float, torch.Tensor | None]:
        done = next(taken) / steps
        factors = None if network is None else feedback.factors(network, now, done, steps)
        rate = initial_rate_factor(psnr) * cosine_factor(done, REPAIR.last_factor)
        return rate, factors

    scenes = optimised(scene, feedback, iter(examples), choose)
    return next(itertools.islice(scenes, steps - 1, None))


def measured(
    scene: JudgedScene,
    share: float,
    networks: dict[str, FeedbackRefiner | None],
    steps: tuple[int, ...],
    known: Iterable[Row] = (),
) -> Iterator[Row]:
    """Rows of a scene: of the merge, then for each number of steps of each network, without those
    that are known."""
    there = {(row["steps"], row["way"]) for row in known}
    wanted = [(0, MERGED), *itertools.product(steps, networks)]
    if there.issuperset(wanted):
        return
    views = ViewProvider(scene.dense)
    small = ps.prune(scene.dense, keep=share, by="merge")
    judge = DenseViews(scene.dense, scene.looks[0].views)
    psnr = DenseReference(scene.dense, views.compared()).psnr(small)[0]
    examples = SharedExamples(scene.dense, views)
    about: Row = {"scene": scene.name, "digest": scene.digest, "keep": share, "count": len(small)}
    for count, way in wanted:
        if (count, way) in there:
            continue
        seconds = examples.draw(count)
        begun = time.process_time()
        result = small
        if count:
            result = repaired(small, len(scene.dense), examples, count, networks[way], psnr)
        seconds += time.process_time() - begun
        row = {"steps": count, "way": way, "psnr": round(judge.psnr(result), 3)}
        yield about | row | {"cpu_seconds": round(seconds, 2)}


def lines(rows: Iterable[Row]) -> list[list[str]]:
    """Cells of :data:`HEADS`: means over scenes, for each number of steps and way."""
    found = []
    by_steps = grouped(rows, lambda row: row["steps"])
    merged = {row["scene"]: row["psnr"] for row in by_steps.pop(0, [])}
    for steps, of_steps in sorted(by_steps.items()):
        ways = grouped(of_steps, lambda row: row["way"])
        shipped = {row["scene"]: row["psnr"] for row in ways.get(SHIPPED, [])}
        for way, members in ways.items():
            psnrs = {row["scene"]: row["psnr"] for row in members}
            base = merged if way == SHIPPED else shipped
            leads = {name: psnrs[name] - base[name] for name in psnrs if name in base}
            worst = min(leads, key=lambda name: leads[name], default=None)
            same = way == SHIPPED or not leads
            found.append(
                [
                    str(steps),
                    way,
                    f"{fmean(psnrs.values()):.2f}",
                    f"{fmean(psnrs[name] - merged[name] for name in psnrs):+.2f}",
                    "-" if worst is None else f"{leads[worst]:+.2f} ({worst})",
                    "-" if same else f"{fmean(leads.values()):+.2f}",
                    f"{fmean(row['cpu_seconds'] for row in members):.1f}",
                ]
            )
    return found


def each_scene(rows: list[Row]) -> str:
    """A table of PSNR by scene, a column for each number of steps and way."""
    columns = list(grouped(rows, lambda row: (row["steps"], row["way"])))
    cells = []
    for scene, members in grouped(rows, lambda row: row["scene"]).items():
        psnrs = {(row["steps"], row["way"]): row["psnr"] for row in members}
        cells.append([scene, *(f"{psnrs[at]:.2f}" if at in psnrs else "-" for at in columns)])
    heads = [way if not steps else f"{way}, {steps}" for steps, way in columns]
    return markdown(["scene", *heads], cells)


def page(rows: list[Row], name: str, views: int, width: int) -> str:
    """The Markdown page of all rows."""
    head = PAGE.format(name=name, keep=100 * rows[0]["keep"], views=views, width=width)
    return head + markdown(HEADS, lines(rows)) + "\n\n" + each_scene(rows) + "\n"


def main(
    scenes: tyro.conf.Positional[tuple[Path, ...]],
    networks: tuple[str, ...] = (),
    steps: tuple[int, ...] = (48, 192, 600),
    adam: bool = True,
    keep: float = 0.1,
    width: int = 960,
    views: int = 12,
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Measure repairs by the shipped network, by plain Adam, and by other networks.

    Args:
        scenes: PLY files that have a camera path of their name.
        networks: NAME=FILE of other networks.
        steps: numbers of steps.
        adam: measure plain Adam, too.
        keep: share of the Gaussians that merging keeps.
        width: of the pictures, pixels; the height is 9/16 of it.
        views: at most so many views of each scene, evenly spread.
        json_path: write all rows there, after each scene, and the page of its name beside it.
    """
    check_options(scenes, (keep,), views, (width,))
    if not steps or min(steps) < 1:
        raise SystemExit(f"--steps {' '.join(map(str, steps))}; expected numbers of at least 1")
    ways: dict[str, FeedbackRefiner | None] = {
        SHIPPED: shipped_feedback_refiner(torch.device("cpu")),
        **({ADAM: None} if adam else {}),
        **{name: read_feedback_refiner(path) for name, path in map(named, networks)},
    }
    settings = {"views": views, "width": width, "keep": keep}
    results = Results(json_path, settings, resume=json_path is not None)
    for scene_name, path in zip(check(scenes), scenes, strict=True):
        scene = load(path, (width,), views)
        rows = [row for row in results.of(scene_name) if row["digest"] == scene.digest]
        for row in measured(scene, keep, ways, steps, list(rows)):
            rows.append(row)
            results.put(scene_name, rows)
            print(
                *(f"{key} {row[key]}" for key in ("scene", "steps", "way", "psnr", "cpu_seconds"))
            )
    console().print(table("mean over scenes", HEADS, lines(results.rows), left=HEADS[:2]))
    if json_path is not None:
        write_page(json_path, lambda rows: page(rows, json_path.name, views, width))


if __name__ == "__main__":
    start(main)
