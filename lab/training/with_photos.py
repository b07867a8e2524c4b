"""Who has the photos: which way to a small scene is best at an equal number of Gaussians and equal CPU seconds?

    python -m lab.training.with_photos fox --steps 2000 --keep 0.1 0.3 --json with_photos.json \\
        --train "splatfacto-cpu --data scannetpp/fox scannetpp-seeded"
    python -m lab.training.with_photos_record with_photos.json

A dense scene is trained by ``ns-train splatfacto-cpu``, and made smaller by each way. The results are compared with the
held-out photos, at the size of the photos. Each way is a process of its own, whose CPU seconds count, with starting and
reading. ``compact --photos`` says how many seconds the others get: training on photos after pruning by a score takes as
long; so does a training with a cap from the start, and a second one takes as long as the dense training besides. A long
``compact --photos`` trains on photos for as many seconds of the clock as the dense training took of the processor.
Finished rows are not measured again.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Annotated

import torch
import tyro

from lab.common.compare import lpips_or_none, metrics_of, photos_of
from lab.common.printing import console, start, table
from lab.common.results import Results, Row
from lab.common.running import folder_of_run
from lab.common.ways import count_of
from lab.judge.scenes import PHOTOS
from pointsplat_ns.io import read_scene
from pointsplat_ns.io.runs import METHOD_NAMES
from pointsplat_ns.metrics.lpips import Lpips
from pointsplat_ns.rasterizer import render
from pointsplat_ns.system.programs import run_measured

DENSE, CAP_SHORT, CAP_LONG = "dense", "cap, short", "cap, long"
"""Names of the dense scene and of trainings with a cap: without and with the seconds of the dense training."""

COMPACTED, COMPACTED_LONG = "compact --photos", "compact --photos, long"
"""The way that says how many seconds the others get; and the same with as many seconds as the dense training took."""

WAYS: dict[str, list[str]] = {
    "prune": ["prune"],
    "compact": ["compact"],
    COMPACTED: ["compact", "--photos"],
}
"""What users of the program give to make a run smaller, but for the run and the budget."""

SCORES = {"lightgaussian": "LightGaussian, trained on", "pup": "PUP-3DGS, trained on"}
"""Scores of prune that training on photos follows, and the names of these ways."""

METHODS = (DENSE, *WAYS, COMPACTED_LONG, *SCORES.values(), CAP_SHORT, CAP_LONG)
"""All ways, in the order of the tables."""

_POINTSPLAT = (sys.executable, "-c", "from pointsplat_ns.cli import program; program()")
_TRAIN = (sys.executable, "-c", "from nerfstudio.scripts.train import entrypoint; entrypoint()")


class Capture:
    """A capture, its trainings in a folder, and its held-out photos.

    Args:
        name: of the capture.
        arguments: of ``ns-train``: splatfacto-cpu, the data, its dataparser and their options.
        steps: number of steps of the dense training.
        folder: for all runs and scenes.
        lpips: the network of LPIPS, if there is one.
    """

    def __init__(self, name: str, arguments: list[str], steps: int, folder: Path, lpips: Lpips | None):
        self.name, self.arguments, self.steps, self.folder, self.lpips = name, arguments, steps, folder, lpips

    @property
    def dense(self) -> Path:
        """The run of the dense training."""
        return folder_of_run(self.folder, self.name, METHOD_NAMES.scene, "dense")

    def train(self, label: str, steps: int, cap: int | None = None) -> tuple[Path, float]:
        """A new training, with a cap or without: its run and its CPU seconds."""
        run = folder_of_run(self.folder, self.name, METHOD_NAMES.scene, label)
        shutil.rmtree(run, ignore_errors=True)
        words = [*_TRAIN, self.arguments[0], "--output-dir", str(self.folder), "--experiment-name", self.name]
        words += ["--timestamp", label, "--max-num-iterations", str(steps), "--vis", "tensorboard"]
        words += ["--early-look", "False", "--steps-per-eval-image", "0", "--steps-per-save", str(steps)]
        words += [] if cap is None else ["--pipeline.model.max-gs-num", str(cap)]
        return run, _cpu_seconds([*words, *self.arguments[1:]])

    def capped(self, count: int, seconds: float, per_step: float, starting: float) -> tuple[Path, float]:
        """A training with a cap of about so many CPU seconds, given those of a step and of the start."""
        steps = max(1, round((seconds - starting) / per_step))
        return self.train(f"cap-{count}-{steps}", steps, count)

    def step_cost(self, count: int) -> tuple[float, float]:
        """CPU seconds of a step of a training with a cap, on average over its schedule, and of the start."""
        few, many = 1, max(20, self.steps // 10)
        costs = [self.train("trial", steps, count)[1] for steps in (few, many)]
        shutil.rmtree(folder_of_run(self.folder, self.name, METHOD_NAMES.scene, "trial"), ignore_errors=True)
        return max(1e-3, (costs[1] - costs[0]) / (many - few)), costs[0]

    def reduced(self, words: list[str], count: int) -> tuple[Path, float]:
        """What a program makes of the dense run, and its CPU seconds."""
        target = self.folder / f"{self.name}-small.ply"
        target.unlink(missing_ok=True)
        return target, _cpu_seconds([*words, str(self.dense), "--keep", str(count), "-o", str(target)])

    @torch.no_grad()
    def row(self, keep: float, method: str, scene: Path, seconds: float, with_dense: bool) -> Row:
        """The row of a result: a file or a run."""
        small = read_scene(scene)
        _, views, photos = photos_of(self.dense, "test", sys.maxsize)
        found = [metrics_of(render(small, view), photo, self.lpips) for view, photo in zip(views, photos, strict=True)]
        means = {name: round(fmean(metrics[name] for metrics in found), 4) for name in found[0]}
        about: Row = {
            "scene": self.name,
            "at": PHOTOS,
            "keep": keep,
            "method": method,
            "count": len(small),
            "photos": len(photos),
        }
        about |= {"width": views.width, "height": views.height, "steps": self.steps}
        return about | {"cpu_seconds": round(seconds, 1), "needs_dense": with_dense} | means


def measured(capture: Capture, keeps: tuple[float, ...], known: list[Row]) -> Iterator[Row]:
    """The rows that are missing."""
    there = {(row["keep"], row["method"]): row for row in known}
    if (1.0, DENSE) not in there:
        row = capture.row(1.0, DENSE, *capture.train("dense", capture.steps), with_dense=False)
        there[1.0, DENSE] = row
        yield row
    dense = there[1.0, DENSE]
    for keep in keeps:
        count = count_of(keep, dense["count"])
        for method, words in WAYS.items():
            if (keep, method) not in there:
                there[keep, method] = capture.row(keep, method, *capture.reduced([*_POINTSPLAT, *words], count), True)
                yield there[keep, method]
        if (keep, COMPACTED_LONG) not in there:
            command = [*_POINTSPLAT, *WAYS[COMPACTED], "--seconds", f"{dense['cpu_seconds']:.0f}"]
            yield capture.row(keep, COMPACTED_LONG, *capture.reduced(command, count), True)
        seconds = there[keep, COMPACTED]["cpu_seconds"]
        for by, method in SCORES.items():
            if (keep, method) not in there:
                command = [sys.executable, "-m", "lab.training.score_and_train", by, str(seconds)]
                yield capture.row(keep, method, *capture.reduced(command, count), True)
        missing = [method for method in (CAP_SHORT, CAP_LONG) if (keep, method) not in there]
        if missing:
            cost = capture.step_cost(count)
            for method in missing:
                given = seconds + (dense["cpu_seconds"] if method == CAP_LONG else 0.0)
                yield capture.row(keep, method, *capture.capped(count, given, *cost), False)


def _cpu_seconds(words: list[str]) -> float:
    print(shlex.join(words), flush=True)
    return run_measured(words).cpu_seconds or 0.0


def main(
    name: tyro.conf.Positional[str],
    train: str,
    steps: int = 2000,
    keep: tuple[float, ...] = (0.1, 0.3),
    folder: Path = Path("outputs/with_photos"),
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
) -> None:
    """Compare ways to a small scene of one capture, in its held-out photos.

    Args:
        name: of the capture.
        train: arguments of ns-train: splatfacto-cpu, the data, its dataparser and their options.
        steps: number of steps of the dense training.
        keep: shares of the Gaussians to keep.
        folder: for trainings and scenes.
        json_path: file of rows of this and other captures, taken up and written after each row.
    """
    lpips = lpips_or_none(True)
    results = Results(json_path, {"lpips": lpips is not None}, json_path is not None)
    folder.mkdir(parents=True, exist_ok=True)
    arguments = shlex.split(train)
    if arguments[:1] != [METHOD_NAMES.scene]:
        raise SystemExit(f"--train {train}; expected it to begin with {METHOD_NAMES.scene}")
    capture = Capture(name, arguments, steps, folder.resolve(), lpips)
    if results.of(name) and not capture.dense.is_dir():
        raise SystemExit(f"{json_path} has rows of {name}, but {capture.dense} is missing; expected the same --folder")
    for row in measured(capture, keep, results.of(name)):
        results.put(name, [*results.of(name), row])
        print(row, flush=True)
    heads = ("kept", "way", "Gaussians", "CPU s", "PSNR", "SSIM", "LPIPS")
    ordered = sorted(results.of(name), key=lambda row: (-row["keep"], METHODS.index(row["method"])))
    cells = [
        (f"{100 * row['keep']:g} %", row["method"], f"{row['count']:,}", f"{row['cpu_seconds']:.0f}")
        + tuple(f"{row[metric]:.3f}" if metric in row else "-" for metric in ("psnr", "ssim", "lpips"))
        for row in ordered
    ]
    console().print(table(f"{name}: held-out photos", heads, cells, left=("way",)))


if __name__ == "__main__":
    start(main)
