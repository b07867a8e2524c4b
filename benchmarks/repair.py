"""What repairing a merged scene brings, in dB over seconds: fine-tuning, Adam, and ``compact``'s repair.

    python benchmarks/repair.py scenes/rock.ply outputs/diorama/splatfacto-cpu/RUN --keep 10% --seconds 5 10 20

Judged in views that no optimisation has seen: two sets of sampled ones, and the held-out photos of a run.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Annotated

import torch
import tyro
from held_out import mean_psnr, name_of, photos_of
from torch import Tensor

import pointsplat_ns as ps
from pointsplat_ns.compression.closeness import DenseReference
from pointsplat_ns.compression.fine_tune import fine_tune
from pointsplat_ns.compression.prune import prune_scene
from pointsplat_ns.compression.repair import STEPS, RepairBudget, repair
from pointsplat_ns.gaussians import Gaussians
from pointsplat_ns.looking.view_source import ViewSource
from pointsplat_ns.nerfstudio_plugin.dataset_views import dataset_views
from pointsplat_ns.refiner.feedback import shipped_feedback_refiner
from pointsplat_ns.views import Views

SETS = {"a": 1001, "b": 1002}
"""Seeds of the two sets of sampled views that judge; no repair takes views of these."""

FINE_TUNED_ON = 40
"""Sampled views that ``prune --fine-tune`` repeats."""


@dataclass(frozen=True)
class Row:
    """One point of a curve."""

    scene: str
    gaussians: int
    keep: str
    kind: str
    """merge, fine-tune (``prune --fine-tune``), Adam (repair without its network) or repair (``compact``)."""
    steps: int
    seconds: float
    """Wall-clock time after merging."""
    cpu_seconds: float
    psnr_a: float
    """Mean PSNR against the dense scene's renders in the first set of sampled views, dB."""
    psnr_b: float
    photo_psnr: float | None
    """Mean PSNR against held-out photos, dB."""


class Judge:
    """Renders of a dense scene in views that nothing else sees, and photos where there are any."""

    @torch.no_grad()
    def __init__(self, path: Path, dense: Gaussians, count: int):
        self.sets: list[tuple[Views, list[Tensor]]] = []
        for seed in SETS.values():
            views = ps.sample_views(dense, count, seed=seed)
            self.sets.append((views, [ps.render(dense, view) for view in views]))
        self.photos = None
        if path.suffix != ".ply":
            _, views, photos = photos_of(path, "test", count)
            self.photos = (views, photos)

    def psnr(self, scene: Gaussians) -> dict[str, float | None]:
        """Mean PSNR in each set and against the photos."""
        first, second = (mean_psnr(scene, *pair) for pair in self.sets)
        photo = self.photos and mean_psnr(scene, *self.photos)
        return {"psnr_a": first, "psnr_b": second, "photo_psnr": photo}


def rows_of(path: Path, keep: str, seconds: list[float], fine_tune_steps: list[int], count: int) -> Iterator[Row]:
    """All points of a scene at one budget, each as soon as it is measured."""
    dense = ps.load(path)
    judge = Judge(path, dense, count)
    source = ViewSource(dense, run=path, dataset_views=dataset_views)
    views = source.compared()
    merged = prune_scene(dense, keep, "merge", views=source).scene

    def row(kind: str, scene: Gaussians, steps: int, started: tuple[float, float]) -> Row:
        wall, cpu = time.perf_counter() - started[0], time.process_time() - started[1]
        return Row(name_of(path), len(dense), keep, kind, steps, wall, cpu, **judge.psnr(scene))

    yield row("merge", merged, 0, now())
    reference = DenseReference(dense, views)
    psnr = reference.psnr_of_covered(reference.closeness(merged).psnr)
    for steps in fine_tune_steps:
        started = now()
        tuned = fine_tune(merged, ps.sample_views(dense, FINE_TUNED_ON), dense, steps)
        yield row("fine-tune", tuned, steps, started)
    for budget in (RepairBudget("quick"), *(RepairBudget(seconds=limit) for limit in seconds)):
        for kind, network in (("Adam", None), ("repair", shipped_feedback_refiner(dense.device))):
            started = now()
            repaired = repair(merged, dense, source, budget, network=network, psnr=psnr)
            yield row(kind, repaired.scene, repaired.steps, started)


def now() -> tuple[float, float]:
    """Wall-clock and CPU time, seconds."""
    return time.perf_counter(), time.process_time()


def plot(rows: list[Row], path: Path) -> None:
    """Gain over merging alone, dB over seconds, one panel a scene."""
    from matplotlib.figure import Figure

    scenes = list(dict.fromkeys((row.scene, row.keep) for row in rows))
    figure = Figure(figsize=(4 * min(len(scenes), 4), 3.2 * -(-len(scenes) // 4)), layout="constrained")
    axes = figure.subplots(-(-len(scenes) // 4), min(len(scenes), 4), squeeze=False).flatten()
    for axis, key in zip(axes, scenes, strict=False):
        here = [row for row in rows if (row.scene, row.keep) == key]
        start = next(row for row in here if row.kind == "merge")
        for kind in ("fine-tune", "Adam", "repair"):
            points = sorted((row.cpu_seconds, gain(row, start)) for row in here if row.kind == kind)
            if points:
                axis.plot(*zip(*points, strict=True), marker="o", label=kind)
        axis.axhline(0, color="grey", linewidth=0.8)
        against = "renders" if start.photo_psnr is None else "held-out photos"
        axis.set(title=f"{key[0]}, {key[1]}", xlabel="CPU seconds after merging", ylabel=f"gain against {against}, dB")
    for axis in axes[len(scenes) :]:
        axis.set_axis_off()
    axes[0].legend()
    figure.savefig(path)


def gain(row: Row, start: Row) -> float:
    """Gain against held-out photos, dB, or where there are none the mean gain in both sets of sampled views."""
    if row.photo_psnr is not None and start.photo_psnr is not None:
        return row.photo_psnr - start.photo_psnr
    return 0.5 * (row.psnr_a + row.psnr_b - start.psnr_a - start.psnr_b)


def main(
    scenes: Annotated[list[Path], tyro.conf.Positional],
    keep: list[str] = ["10%"],  # noqa: B006 - never changed
    seconds: list[float] = [],  # noqa: B006
    fine_tune_steps: list[int] = [],  # noqa: B006
    views: int = 8,
    output: Path = Path("repair.csv"),
) -> None:
    """Measure what repairing merged scenes brings.

    Args:
        scenes: .ply files and Splatfacto runs.
        keep: budgets.
        seconds: times to repair; the effort "quick" is always measured.
        fine_tune_steps: lengths of ``prune --fine-tune``, for comparison.
        views: number of views in each judging set.
        output: the .csv file to write, after each point; a .png of the curves is drawn beside it.
    """
    print(f"threads: {torch.get_num_threads()}, torch {torch.__version__}; quick: {STEPS['quick']} steps")
    rows: list[Row] = []
    for path in scenes:
        for budget in keep:
            for row in rows_of(path, budget, seconds, fine_tune_steps, views):
                rows.append(row)
                photo = "" if row.photo_psnr is None else f", photos {row.photo_psnr:.2f}"
                print(
                    f"{row.scene} {row.keep} {row.kind} {row.steps} steps, {row.seconds:.1f} s "
                    f"({row.cpu_seconds:.1f} CPU s): {row.psnr_a:.2f} and {row.psnr_b:.2f} dB{photo}",
                    flush=True,
                )
                with output.open("w", newline="") as file:
                    writer = csv.DictWriter(file, [field.name for field in fields(Row)])
                    writer.writeheader()
                    writer.writerows(asdict(row) for row in rows)
    plot(rows, output.with_suffix(".png"))


if __name__ == "__main__":
    tyro.cli(main)
