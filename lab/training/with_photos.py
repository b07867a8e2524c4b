"""Who has the photos: which way to a small scene is best at an equal number of Gaussians and equal
CPU seconds?

    python -m lab.training.with_photos fox --steps 2000 --keep 0.1 0.3 --json with_photos.json \\
        --train "splatfacto-cpu --data scannetpp/fox scannetpp-seeded"
    python -m lab.training.with_photos --write with_photos.json      # docs/record/with_photos.md

A dense scene is trained by ``ns-train splatfacto-cpu``, and made smaller by each way. The results
are compared with the held-out photos, at the size of the photos. Each way is a process of its own,
whose CPU seconds count, with starting and reading. Training on photos after pruning by a score
takes as long as ``compact --photos``. A long ``compact --photos`` trains on photos for as many
seconds of the clock as the dense training took of the processor. Finished rows are not measured
again.
"""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from statistics import fmean
from typing import Annotated

import pandas as pd
import torch
import tyro

from lab.common.compare import lpips_or_none, metrics_of, photos_of
from lab.common.printing import markdown, percent, start
from lab.common.programs import run_measured
from lab.common.results import Results, Row, grouped
from lab.common.running import folder_of_run
from lab.common.ways import count_of
from lab.judge.record import FOLDER, read, write_rows
from lab.judge.scenes import PHOTOS
from pointsplat_ns.metrics.lpips import Lpips
from pointsplat_ns.pipeline.repair_budget import PHOTO_STEPS
from pointsplat_ns.rendering import render
from pointsplat_ns.scene.reading import read_scene
from pointsplat_ns.scene.runs import METHOD_NAMES
from pointsplat_ns.system.files import replacing

DENSE = "dense"
"""Name of the dense scene."""

COMPACTED = "compact --photos"
COMPACTED_LONG = "compact --photos, long"
"""The way that says how many seconds the others get; and the same with as many seconds as the dense
training took."""

WAYS: dict[str, list[str]] = {
    "prune": ["prune"],
    "compact": ["compact"],
    COMPACTED: ["compact", "--photos"],
}
"""What users of the program give to make a run smaller, but for the run and the budget."""

SCORES = {"lightgaussian": "LightGaussian", "pup": "PUP-3DGS"}
"""Scores of prune that training on photos follows, and the names of these ways."""

METHODS = (DENSE, *WAYS, COMPACTED_LONG, *SCORES.values())
"""All ways, in the order of the tables."""

PAGE = f"""# With the photos at hand

`lab/training/with_photos.py` measured [with_photos.json](with_photos.json) and writes this page from it. Constants of
`{COMPACTED}` are chosen on fox, kitchen and vr_project. The others judge.

- Figures of a scene are CPU seconds/PSNR (dB)/LPIPS, means over held-out photos; "-" was not measured.
- CPU seconds are of one thread of a busy machine: equal work differs by up to a half.
- Dense scenes are of 2,000 steps. `{COMPACTED}` trains for {PHOTO_STEPS["quick"]:,}.
- LightGaussian and PUP-3DGS: the Gaussians with the highest scores, trained as `{COMPACTED}` does, for as many CPU
  seconds as that takes in all. Their scoring comes on top. Their own schedules are longer.
"""

LONG = (
    f'- "{COMPACTED_LONG}" takes `--seconds` of the CPU seconds of the dense training: about half '
    "as many."
)

FIGURES = {"cpu_seconds": ",.0f", "psnr": ".2f", "lpips": ".3f"}
"""Figures of a way at one budget, with their formats."""


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

    def __init__(
        self, name: str, arguments: list[str], steps: int, folder: Path, lpips: Lpips | None
    ):
        self.name = name
        self.arguments = arguments
        self.steps = steps
        self.folder = folder
        self.lpips = lpips

    @property
    def dense(self) -> Path:
        """The run of the dense training."""
        return folder_of_run(self.folder, self.name, METHOD_NAMES.scene, "dense")

    def train(self) -> tuple[Path, float]:
        """A new dense training: its run and its CPU seconds."""
        shutil.rmtree(self.dense, ignore_errors=True)
        words = [
            *_TRAIN,
            self.arguments[0],
            "--output-dir",
            str(self.folder),
            "--experiment-name",
            self.name,
        ]
        words += [
            "--timestamp",
            "dense",
            "--max-num-iterations",
            str(self.steps),
            "--vis",
            "tensorboard",
        ]
        words += ["--steps-per-eval-image", "0", "--steps-per-save", str(self.steps)]
        return self.dense, _cpu_seconds([*words, *self.arguments[1:]])

    def reduced(self, program: list[str], count: int, options: list[str]) -> tuple[Path, float]:
        """What a program makes of the dense run, with options, and its CPU seconds."""
        target = self.folder / f"{self.name}-small.ply"
        target.unlink(missing_ok=True)
        words = [*program, str(self.dense), "--keep", str(count), "-o", str(target), *options]
        return target, _cpu_seconds(words)

    @torch.no_grad()
    def row(self, keep: float, method: str, scene: Path, seconds: float, with_dense: bool) -> Row:
        """The row of a result: a file or a run."""
        small = read_scene(scene)
        _, views, photos = photos_of(self.dense, "test", sys.maxsize)
        found = [
            metrics_of(render(small, view), photo, self.lpips)
            for view, photo in zip(views, photos, strict=True)
        ]
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


def measured(
    capture: Capture, keeps: tuple[float, ...], known: list[Row], long: bool = True
) -> Iterator[Row]:
    """The rows that are missing, of the long training only if it is asked for."""
    there = {(row["keep"], row["method"]): row for row in known}
    if (1.0, DENSE) not in there:
        row = capture.row(1.0, DENSE, *capture.train(), with_dense=False)
        there[1.0, DENSE] = row
        yield row
    dense = there[1.0, DENSE]
    for keep in keeps:
        count = count_of(keep, dense["count"])
        for method, (command, *options) in WAYS.items():
            if (keep, method) not in there:
                found = capture.reduced([*_POINTSPLAT, command], count, options)
                there[keep, method] = capture.row(keep, method, *found, True)
                yield there[keep, method]
        if long and (keep, COMPACTED_LONG) not in there:
            command, *options = *WAYS[COMPACTED], "--seconds", f"{dense['cpu_seconds']:.0f}"
            yield capture.row(
                keep,
                COMPACTED_LONG,
                *capture.reduced([*_POINTSPLAT, command], count, options),
                True,
            )
        seconds = there[keep, COMPACTED]["cpu_seconds"]
        for by, method in SCORES.items():
            if (keep, method) not in there:
                program = [sys.executable, "-m", "lab.training.score_and_train", by, str(seconds)]
                yield capture.row(keep, method, *capture.reduced(program, count, []), True)


def _cpu_seconds(words: list[str]) -> float:
    print(shlex.join(words), flush=True)
    return run_measured(words).cpu_seconds or 0.0


def page(rows: list[Row]) -> str:
    """The page of all tables."""
    parts = [
        PAGE.strip() + (f"\n{LONG}" if any(row["method"] == COMPACTED_LONG for row in rows) else "")
    ]
    leads = lead_table(rows)
    if leads:
        parts.append(
            f"## Lead of `{COMPACTED}`\n\nPSNR in dB above each way, mean "
            f"(smallest…largest):\n\n{leads}"
        )
    for scene, same in sorted(grouped(rows, lambda row: row["scene"]).items()):
        dense = next(row for row in same if row["method"] == DENSE)
        about = f"Dense: {dense['count']:,} Gaussians, {_cell(dense)}"
        photos = f"{dense['photos']} photos of {dense['width']}x{dense['height']}"
        parts.append(f"## {scene}\n\n{about}. {photos}.\n\n{scene_table(same)}")
    return "\n\n".join(parts) + "\n"


def scene_table(rows: list[Row]) -> str:
    """All ways for one capture, budgets side by side."""
    found = {(row["method"], row["keep"]): row for row in rows if row["method"] != DENSE}
    keeps = sorted({keep for _, keep in found}, reverse=True)
    ways = sorted({method for method, _ in found}, key=METHODS.index)
    lines = [[way, *(_cell(found.get((way, keep), {})) for keep in keeps)] for way in ways]
    return markdown(["way", *map(percent, keeps)], lines)


def _cell(row: Row) -> str:
    """The figures of a row that it has, "-" for none."""
    return "/".join(format(row[name], form) for name, form in FIGURES.items() if name in row) or "-"


def lead_table(rows: list[Row]) -> str:
    """How much better ``compact --photos`` is than each way, over captures; empty if it has no
    row."""
    psnr = pd.DataFrame(rows).pivot_table(index=["keep", "scene"], columns="method", values="psnr")
    dense = {scene: value for (keep, scene), value in psnr[DENSE].dropna().items()}
    psnr[DENSE] = psnr.index.get_level_values("scene").map(dense)
    if COMPACTED not in psnr:
        return ""
    leads = psnr.rsub(psnr[COMPACTED], axis=0).drop(columns=COMPACTED)
    keeps = sorted(set(psnr[COMPACTED].dropna().index.get_level_values("keep")), reverse=True)
    lines = []
    for method in (method for method in METHODS if method in leads):
        found = [leads.loc[keep, method].dropna() for keep in keeps]
        spans = [
            f"{f.mean():+.2f} ({f.min():+.2f}…{f.max():+.2f}), {len(f)}" if len(f) else "-"
            for f in found
        ]
        lines += [[method, *spans]] if any(map(len, found)) else []
    return markdown(["over", *(f"{percent(keep)}, captures" for keep in keeps)], lines)


def write(files: tuple[Path, ...], folder: Path) -> None:
    """Write with_photos.json and with_photos.md from files of this program.

    Raises:
        SystemExit: if a file cannot be read, or there is no dense scene.
    """
    rows, settings = read(files, "with_photos.py")
    if not any(row["method"] == DENSE for row in rows):
        raise SystemExit(f"{', '.join(map(str, files))}: no row of a dense scene")
    write_rows(rows, settings, folder / "with_photos.json")
    with replacing(folder / "with_photos.md") as part:
        part.write_text(page(rows), "utf-8")
    print(folder / "with_photos.md")


def main(
    name: tyro.conf.Positional[str] = "",
    train: str = "",
    steps: int = 2000,
    keep: tuple[float, ...] = (0.1, 0.3),
    folder: Path = Path("outputs/with_photos"),
    json_path: Annotated[Path | None, tyro.conf.arg(name="json")] = None,
    write_from: Annotated[tuple[Path, ...], tyro.conf.arg(name="write")] = (),
    record: Path = FOLDER,
    long: bool = True,
) -> None:
    """Compare ways to a small scene of one capture, in its held-out photos.

    Args:
        name: of the capture.
        train: arguments of ns-train: splatfacto-cpu, the data, its dataparser and their options.
        steps: number of steps of the dense training.
        keep: shares of the Gaussians to keep.
        folder: for trainings and scenes.
        json_path: file of rows of this and other captures, taken up and written after each row.
        write_from: only write the record, from these files.
        record: folder of the record.
        long: whether to measure the long training, too.
    """
    if write_from:
        write(write_from, record)
        return
    lpips = lpips_or_none(True)
    results = Results(json_path, {"lpips": lpips is not None}, json_path is not None)
    folder.mkdir(parents=True, exist_ok=True)
    arguments = shlex.split(train)
    if arguments[:1] != [METHOD_NAMES.scene]:
        raise SystemExit(f"--train {train}; expected it to begin with {METHOD_NAMES.scene}")
    capture = Capture(name, arguments, steps, folder.resolve(), lpips)
    if results.of(name) and not capture.dense.is_dir():
        raise SystemExit(
            f"{json_path} has rows of {name}, but {capture.dense} is missing; expected the same "
            "--folder"
        )
    for row in measured(capture, keep, results.of(name), long):
        results.put(name, [*results.of(name), row])
        print(row, flush=True)
    print(scene_table(results.of(name)))


if __name__ == "__main__":
    start(main)
